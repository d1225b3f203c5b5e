"""The detector of the stress suite's cases."""

from __future__ import annotations

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head


def small_detector(num_classes: int) -> RetinaNet:
    """A RetinaNet for images of 32 x 32 pixels."""
    return RetinaNet(num_classes, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
