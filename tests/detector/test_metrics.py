import math

import pytest
import torch

from neural_sim.detector.metrics import evaluate, worthless
from neural_sim.types import LabelledImages

BOX = [10.0, 10.0, 30.0, 30.0]
NAMES = ["can", "mug", "drill"]


def labelled(labels, boxes=None) -> LabelledImages:
    labels = torch.tensor(labels)
    boxes = torch.tensor([[BOX]] * len(labels)) if boxes is None else torch.tensor(boxes)
    return LabelledImages(torch.zeros(len(labels), 3, 48, 48), boxes, labels, torch.full((len(labels),), -1))


def found(boxes, scores, labels) -> dict[str, torch.Tensor]:
    return {
        "boxes": torch.tensor(boxes).reshape(-1, 4),
        "scores": torch.tensor(scores),
        "labels": torch.tensor(labels, dtype=torch.long),
    }


def test_perfect_detections_score_one_and_absent_classes_nan():
    images = labelled([[0], [1]])
    score = evaluate([found([BOX], [0.9], [0]), found([BOX], [0.8], [1])], images, NAMES)
    assert score.ap == pytest.approx(1.0)
    assert score.ap50 == pytest.approx(1.0)
    assert math.isnan(score.per_class["drill"])
    assert math.isnan(score.per_class_ap50["drill"])


def test_a_class_only_predicted_is_absent_too():
    images = labelled([[0]])
    score = evaluate([found([BOX, BOX], [0.9, 0.95], [0, 2])], images, NAMES)
    assert score.ap == pytest.approx(1.0)
    assert math.isnan(score.per_class["drill"])


def test_overlap_decides_which_thresholds_count():
    # Width 14 of 20 inside the truth: IoU 0.7, so thresholds 0.50 to 0.70 of the ten are met (five of ten).
    score = evaluate([found([[10.0, 10.0, 24.1, 30.0]], [0.9], [0])], labelled([[0]]), NAMES)
    assert score.ap == pytest.approx(0.5)
    assert score.ap50 == pytest.approx(1.0)


def test_a_better_scored_false_positive_halves_the_precision():
    images = labelled([[0], [-1]])
    predictions = [found([BOX], [0.5], [0]), found([BOX], [0.9], [0])]
    assert evaluate(predictions, images, NAMES).ap == pytest.approx(0.5)


def test_a_missed_half_has_101_point_recall():
    # Recall stops at 1/2: the recall points 0, 0.01, ..., 0.50 are 51 of 101.
    images = labelled([[0], [0]])
    predictions = [found([BOX], [0.5], [0]), found([], [], [])]
    assert evaluate(predictions, images, NAMES).ap == pytest.approx(51 / 101)


def test_classes_count_equally():
    images = labelled([[0], [0], [0], [1]])
    predictions = [found([BOX], [0.9], [0])] * 3 + [found([], [], [])]
    score = evaluate(predictions, images, NAMES)
    assert score.per_class["mug"] == 0.0
    assert score.ap == pytest.approx(0.5)


def test_nothing_found_and_nothing_there():
    empty = found([], [], [])
    assert evaluate([empty], labelled([[0]]), NAMES).ap == 0.0
    assert math.isnan(evaluate([empty], labelled([[-1]]), NAMES).ap)


def test_a_score_that_tells_nothing_says_why_in_one_line():
    empty, wrong, right = found([], [], []), found([BOX], [0.9], [1]), found([BOX], [0.9], [0])
    for predictions, labels, score, why in (
        ([empty], [[0]], "AP", "it is 0 for every class: it detects nothing; want more training"),
        ([wrong], [[0]], "AP", "none of its 1 boxes lies on an object of its class"),
        ([right], [[-1]], "AP", "no class has a box in these images"),
        ([wrong, wrong], [[0], [2]], "accuracy", "no image's best class is right"),
        ([right, empty], [[0], [1]], "AP", None),
    ):
        images = labelled(labels)
        said = worthless(evaluate(predictions, images, NAMES, score), predictions)
        assert said is None if why is None else why in said


def test_mismatches_and_empty_sets_are_refused():
    with pytest.raises(ValueError, match="no images"):
        evaluate([], labelled([[0]]).select(slice(0, 0)), NAMES)
    with pytest.raises(ValueError, match="one prediction per image"):
        evaluate([], labelled([[0]]), NAMES)
    with pytest.raises(ValueError, match="has no name"):
        evaluate([found([], [], [])], labelled([[5]]), NAMES)
