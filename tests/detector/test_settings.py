"""Ranges of the detector's settings across several of them, and of classes that conf/ does not make."""

from functools import partial

import pytest

from neural_sim.detector.real import Real
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head, Points
from neural_sim.detector.training import Optimisation, Training
from neural_sim.detector.trajectory import Recording

THREE = {"strides": (8, 16, 32)}
CASES = [
    (Backbone, {"freeze": True}, "Backbone.weights: want weights with freeze=true"),
    (Head, {"channels": 12}, "Head.channels: want at least 8 and a multiple of 8, got 12"),
    (Anchors, {"sizes": ((8,),)}, "Anchors.sizes: want one list for each stride, all of them equally long"),
    (Anchors, {"sizes": ((8,), (16, 24))}, "Anchors.sizes: want one list for each stride"),
    (Anchors, {"sizes": ((8,), (0,))}, "Anchors.sizes[1][0]: want more than 0"),
    (Anchors, {"strides": (), "sizes": ()}, "Anchors.strides: want 1 or more values"),
    (Anchors, {"foreground_iou": 0.3}, "Anchors.foreground_iou: want at least background_iou=0.4, got 0.3"),
    (Points, {**THREE, "limits": (20, 10)}, "Points.limits: want increasing values, got [20, 10]"),
    (Points, {**THREE, "limits": (10, 10)}, "Points.limits: want increasing values"),
    (Points, {"limits": ()}, "Points.limits: want one for each stride but the last"),
    (partial(RetinaNet, 3), {"image_size": (32, 0)}, "RetinaNet.image_size[1]: want at least 1, got 0"),
    (Real, {"count": 3, "fraction": 0.5}, "want count or fraction, got both"),
    (Training, {"batch_size": 1, "real": Real("combined")}, "Training.batch_size: want at least 2"),
    (Optimisation, {"epochs": 0}, "Optimisation.epochs: want at least 1"),
    (partial(Optimisation, 1), {"batch_size": 0}, "Optimisation.batch_size: want at least 1"),
    (Recording, {"max_memory_mb": 0.0}, "Recording.max_memory_mb: want more than 0"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
