"""What is printed of a saved detector's scores on labelled photographs."""

import math

from neural_sim.detector.metrics import Accuracy, AveragePrecision
from neural_sim.report.detections import scores_table


def test_a_detector_s_scores_are_two_and_a_classifier_s_one():
    ap = AveragePrecision(0.5, 0.75, {"can": 0.5, "mug": math.nan}, {"can": 0.75, "mug": math.nan})
    accuracy = Accuracy(0.25, {"can": 0.25, "mug": math.nan})
    lines = [line.split() for line in scores_table(ap, 4).splitlines()]
    assert lines == [
        ["AP", "on", "4", "pictures", "AP", "AP50"], ["can", "50.0", "75.0"], ["mug", "nan", "nan"],
        ["mean", "50.0", "75.0"],
    ]  # fmt: skip
    named = AveragePrecision(0.5, 0.75, {"mean": 0.25, "can": 0.75}, {"mean": 0.5, "can": 1.0})
    rows = [line.split() for line in scores_table(named, 4).splitlines()[1:]]  # a class may have that name
    assert rows == [["mean", "25.0", "50.0"], ["can", "75.0", "100.0"], ["mean", "50.0", "75.0"]]
    lines = [line.split() for line in scores_table(accuracy, 4).splitlines()]
    assert lines == [
        ["accuracy", "on", "4", "pictures", "accuracy"], ["can", "25.0"], ["mug", "nan"], ["mean", "25.0"]
    ]  # fmt: skip
