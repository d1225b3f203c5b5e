"""AP from matches against faster-coco-eval, accuracy against torchmetrics', on random detections and resampled sets."""

import numpy as np
import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy

from neural_sim.detector.metrics import evaluate
from neural_sim.report.bootstrap import average_precision, class_score, match
from neural_sim.types import LabelledImages


def _case(generator, count=30):
    corner = 40 * torch.rand(count, 2, 2, generator=generator)
    boxes = torch.cat([corner, corner + 20 + 20 * torch.rand(count, 2, 2, generator=generator)], -1)
    labels = torch.randint(-1, 2, (count, 2), generator=generator)
    images = LabelledImages(torch.zeros(count, 3, 8, 8), boxes, labels, torch.zeros(count).long())
    found = []
    for i in range(count):
        noise = (4 * torch.randn(2, 4, generator=generator)).clamp(-9, 9)  # boxes keep their area
        wild = torch.tensor([[5.0, 5, 30, 30]])
        found.append(
            {
                "boxes": torch.cat([boxes[i] + noise, boxes[i], wild]),
                "scores": torch.rand(5, generator=generator),
                "labels": torch.randint(0, 2, (5,), generator=generator),
            }
        )
    return found, images


def test_equals_coco_evaluation(generator):
    found, images = _case(generator)
    expected = evaluate(found, images, ["a", "b"]).per_class
    for label, name in enumerate(["a", "b"]):
        assert average_precision(match(found, images, label)) == pytest.approx(expected[name], abs=1e-6)


def test_integer_weights_equal_repeated_images(generator):
    found, images = _case(generator, count=12)
    times = torch.randint(0, 3, (12,), generator=generator)
    index = torch.arange(12).repeat_interleave(times)
    repeated = average_precision(match([found[i] for i in index], images.select(index), 0))
    weighted = average_precision(match(found, images, 0), times.double().numpy())
    assert weighted == pytest.approx(repeated, abs=0.02)  # equal scores of copies are ranked in another order
    assert weighted != average_precision(match(found, images, 0))


def test_no_boxes_is_nan_and_no_detections_is_zero():
    images = LabelledImages(
        torch.zeros(1, 3, 8, 8), torch.tensor([[[1.0, 1, 5, 5]]]), torch.tensor([[0]]), torch.zeros(1).long()
    )
    nothing = [{"boxes": torch.zeros(0, 4), "scores": torch.zeros(0), "labels": torch.zeros(0).long()}]
    assert average_precision(match(nothing, images, 0)) == 0.0
    assert np.isnan(average_precision(match(nothing, images, 1)))


def test_accuracy_under_weights_is_torchmetrics_of_repeated_images(generator):
    count, whole = 40, torch.tensor([[0.0, 0, 8, 8]])
    truth, said = (torch.randint(0, 3, (count,), generator=generator) for _ in range(2))
    boxes = torch.tensor([1.0, 1, 5, 5]).expand(count, 1, 4)
    images = LabelledImages(torch.zeros(count, 3, 8, 8), boxes, truth[:, None], torch.zeros(count).long())
    found = [{"boxes": whole, "scores": torch.ones(1), "labels": label[None]} for label in said]
    times = torch.randint(0, 4, (count,), generator=generator)
    index = torch.arange(count).repeat_interleave(times)
    for rows, weights in ((torch.arange(count), None), (index, times.double().numpy())):
        wanted = MulticlassAccuracy(3, average=None)(said[rows], truth[rows]).tolist()
        ours = [class_score(match(found, images, label, "accuracy"), weights) for label in range(3)]
        assert ours == pytest.approx(wanted, abs=1e-6)
    assert np.isnan(class_score(match(found, images, 3, "accuracy")))
    assert class_score(match(found, images, 0)) == average_precision(match(found, images, 0))
