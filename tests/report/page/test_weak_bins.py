"""AP by bin, where the detections of every bin are known."""

import pytest
import torch

from neural_sim.report.page.weak_bins import bin_scores, weakest
from neural_sim.types import LabelledImages

BOX = torch.tensor([[2.0, 2.0, 10.0, 10.0]])


def images(bins, labels):
    count = len(bins)
    return LabelledImages(torch.zeros(count, 3, 12, 12), BOX.expand(count, 1, 4), labels[:, None], bins)


def detections(labels, found):
    none = {"boxes": BOX[:0], "labels": torch.zeros(0).long(), "scores": torch.zeros(0)}
    return [
        {"boxes": BOX, "labels": label[None], "scores": torch.ones(1)} if hit else none
        for label, hit in zip(labels, found, strict=True)
    ]


def test_a_bin_scores_on_its_own_images():
    bins = torch.tensor([0] * 10 + [1] * 10 + [0] * 5 + [3] * 3)
    labels = torch.tensor([0] * 20 + [1] * 8)
    nothing, half = torch.zeros(28, dtype=torch.bool), torch.arange(28) % 2 == 0
    half[:10] = True  # bin 1 of a: all found
    half[25:] = False
    found = {"ns": detections(labels, nothing), "learned": detections(labels, half)}
    scores = bin_scores(["a", "b"], found, images(bins, labels))
    # Bin 4 of b has three images only.
    assert [(s.name, s.bin, s.images) for s in scores] == [("a", 1, 10), ("a", 2, 10), ("b", 1, 5)]
    assert [s.ap["ns"] for s in scores] == [0.0] * 3
    assert [s.last for s in scores] == pytest.approx([1.0, 0.5, 0.6], abs=0.02)
    assert [s.change for s in scores] == [s.last for s in scores]
    assert [s.fraction for s in scores] == [0.5, 0.5, 5 / 8]
    # 5 of b's 8 images lack 0.4, 10 of a's 20 lack 0.5.
    assert weakest(scores, 2) == [scores[2], scores[1]]
    assert [s.missing for s in scores] == pytest.approx([0.0, 0.25, 0.25], abs=0.01)


def test_bins_of_boxes_count_for_their_own_object():
    both = LabelledImages(
        torch.zeros(6, 3, 12, 12),
        BOX.expand(6, 2, 4),
        torch.tensor([[0, 1]] * 6),
        torch.tensor([[2, -1]] * 6),
    )
    found = [{"boxes": BOX, "labels": torch.zeros(1).long(), "scores": torch.ones(1)}] * 6
    (score,) = bin_scores(["a", "b"], {"ns": found, "learned": found}, both)  # b's bins are unknown
    assert (score.name, score.bin, score.images, score.fraction) == ("a", 3, 6, 1.0)
