"""Ranges of the synthesiser's settings across several of them, and of classes that conf/ does not make."""

from functools import partial

import pytest

from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.distractors import Distractors
from neural_sim.synthesis.sensor import Sensor
from neural_sim.synthesis.synthesizer import Synthesizer

CLUTTERED = partial(Synthesizer, ProceduralClutter())
CASES = [
    (CLUTTERED, {"objects_per_image": (0, 0)}, "Synthesizer.objects_per_image[1]: want at least 1, got 0"),
    (CLUTTERED, {"objects_per_image": (2,)}, "Synthesizer.objects_per_image: want a list of 2 values"),
    (Synthesizer, {"background": "clutter"}, "Synthesizer.background: want "),
    (Sensor, {"blur": [1.0]}, "Sensor.blur: want a list of 2 values"),
    (Distractors, {"root": "nowhere"}, "Distractors.root: want a folder of pictures, got nowhere"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
