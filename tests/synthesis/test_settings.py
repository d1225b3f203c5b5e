"""The synthesiser's settings have ranges, and a value out of one is refused by its key."""

import math
from functools import partial

import pytest

from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.distractors import Distractors
from neural_sim.synthesis.sensor import Sensor
from neural_sim.synthesis.synthesizer import Synthesizer

CLUTTERED = partial(Synthesizer, ProceduralClutter())
CASES = [
    (CLUTTERED, {"shift": -0.1}, "Synthesizer.shift: want at least 0 and at most 1, got -0.1"),
    (CLUTTERED, {"threshold": 1.0}, "Synthesizer.threshold: want at least 0 and less than 1"),
    (CLUTTERED, {"minimum_area": -1.0}, "Synthesizer.minimum_area: want at least 0"),
    (CLUTTERED, {"minimum_area": math.inf}, "Synthesizer.minimum_area: want at least 0 and finite, got inf"),
    (CLUTTERED, {"min_visibility": 1.1}, "Synthesizer.min_visibility: want at least 0 and at most 1"),
    (CLUTTERED, {"objects_per_image": (0, 0)}, "Synthesizer.objects_per_image[1]: want at least 1, got 0"),
    (CLUTTERED, {"objects_per_image": (2, 1)}, "Synthesizer.objects_per_image: want values that do not decrease"),
    (CLUTTERED, {"objects_per_image": (2,)}, "Synthesizer.objects_per_image: want a list of 2 values"),
    (Synthesizer, {"background": "clutter"}, "Synthesizer.background: want "),
    (Sensor, {"blur": [1.0, 0.5]}, "Sensor.blur: want values that do not decrease, got [1.0, 0.5]"),
    (Sensor, {"blur": [1.0]}, "Sensor.blur: want a list of 2 values"),
    (Sensor, {"noise": [-0.1, 0.1]}, "Sensor.noise[0]: want at least 0"),
    (Distractors, {"count": (2, 1)}, "Distractors.count: want values that do not decrease, got [2, 1]"),
    (Distractors, {"size": (0.0, 1.0)}, "Distractors.size[0]: want more than 0 and at most 4"),
    (Distractors, {"front": 1.5}, "Distractors.front: want at least 0 and at most 1, got 1.5"),
    (Distractors, {"root": "nowhere"}, "Distractors.root: want a folder of pictures, got nowhere"),
    (ProceduralClutter, {"octaves": 0}, "ProceduralClutter.octaves: want at least 1"),
    (ProceduralClutter, {"contrast": -1.0}, "ProceduralClutter.contrast: want at least 0"),
    (ProceduralClutter, {"distractors": 1.2}, "ProceduralClutter.distractors: want at least 0 and at most 1"),
    (ProceduralClutter, {"grain": -0.1}, "ProceduralClutter.grain: want at least 0"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
