"""The table of scores, on outcomes whose scores are known; AP and accuracy against other libraries', resampled too."""

import numpy as np
import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy

from neural_sim.detector.metrics import evaluate
from neural_sim.report.score_table import (
    THRESHOLDS,
    Matches,
    ScoreTable,
    average_precision,
    class_score,
    match,
)
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


IMAGES = 40


def outcomes(fraction, seed=0, shown=True):
    """A box an image, a fraction of them found at every overlap: AP is about that fraction. No box: no score."""
    found = np.sort(np.random.default_rng(seed).permutation(IMAGES)[: round(fraction * IMAGES)])
    correct = np.ones((len(found), len(THRESHOLDS)), dtype=bool)
    return Matches(found, correct, np.full(IMAGES, int(shown)))


def table(draws=30, **fractions):
    """``fractions`` are [seed][class] of each detector."""
    made = {
        name: [[outcomes(f, 10 * s + c) for c, f in enumerate(row)] for s, row in enumerate(rows)]
        for name, rows in fractions.items()
    }
    return ScoreTable.of(made, ("can", "mug"), draws)


def test_a_mean_is_over_classes_and_seeds_and_lies_in_its_interval():
    made = table(ns=[(0.2, 0.4), (0.3, 0.5)], learned=[(0.6, 0.6), (0.8, 0.8)])
    each = [average_precision(outcomes(f, s)) for f, s in ((0.2, 0), (0.4, 1), (0.3, 10), (0.5, 11))]
    mean = made.mean("ns")
    assert mean.value == pytest.approx(np.mean(each)) and 0.0 <= mean.low < mean.value < mean.high <= 1.0
    assert made.of_classes(["mug"]).mean("ns").value == pytest.approx(np.mean(each[1::2]))
    assert made.by_class("ns")["can"] == pytest.approx(np.mean(each[::2]))
    assert made.ahead("learned", "ns").value == pytest.approx(made.mean("learned").value - mean.value)


def test_equal_detectors_differ_by_nothing_in_every_draw():
    made = table(ns=[(0.5, 0.4)] * 2, learned=[(0.5, 0.4)] * 2)
    ahead = made.ahead("learned", "ns")
    assert (ahead.value, ahead.low, ahead.high) == (0.0, 0.0, 0.0) and not ahead.certain


def test_the_fraction_closed_is_that_of_the_means():
    made = table(ns=[(0.2, 0.2)] * 3, learned=[(0.5, 0.5)] * 3, matched=[(0.8, 0.8)] * 3)
    closed = made.closed("learned")
    assert closed.value == pytest.approx(0.5, abs=0.02) and closed.low < closed.value < closed.high
    assert made.closed("matched").value == 1.0 and made.closed("ns").value == 0.0


def test_a_class_without_boxes_is_in_no_mean():
    rows = {"ns": [[outcomes(0.5), outcomes(0.5, shown=False)]]}
    made = ScoreTable.of(rows, ("can", "mug"), 5)
    assert made.shown == ["can"] and made.mean("ns") == made.of_classes(["can"]).mean("ns")


def test_a_class_has_the_mean_of_the_seeds_that_show_it():
    rows = {"ns": [[outcomes(0.5), outcomes(0.25, shown=False)], [outcomes(0.75), outcomes(0.25)]]}
    found = ScoreTable.of(rows, ("can", "mug"), 5).by_class("ns")
    assert found == pytest.approx({"can": 0.625, "mug": 0.25}, abs=0.01)


def test_scatter_is_a_standard_deviation_between_seeds_and_over_images():
    made = table(200, ns=[(0.4, 0.4), (0.6, 0.6)], learned=[(0.5, 0.5), (0.5, 0.5)])
    (low, high), found = made.sample("ns")[0], made.scatter()
    assert found.seeds == pytest.approx((0.5 * (high - low) ** 2 / 2) ** 0.5, rel=1e-6)
    # The mean of two classes of independent hits: sqrt(0.25 / 40 / 2).
    assert found.images == pytest.approx((0.25 / IMAGES / 2) ** 0.5, rel=0.25)
