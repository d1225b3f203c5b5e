"""AP by bin, where the detections of every bin are known."""

import dataclasses

import pytest
import torch

from neural_sim.report.page.weak_bins import BinScore, bin_scores, forgotten, weaknesses
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
    # Half of a's images score 0.5 less than its best bin; b has one bin, and nothing to hold it against.
    (weak,) = weaknesses(scores)
    assert weak.score == scores[1] and weak.best == scores[0] and weak.gain == pytest.approx(0.25, abs=0.01)
    assert weak.reason == "bin 1 has 100"


def test_a_bin_is_held_against_the_detector_of_the_target_too():
    one = BinScore("a", 1, 10, 0.8, {"ns": 0.2, "learned": 0.5, "matched": 0.7})
    (weak,) = weaknesses([one])
    assert weak.gain == pytest.approx(0.16) and "reaches 70 here, so a larger share would help" in weak.reason
    best = BinScore("a", 2, 10, 0.2, {"ns": 0.2, "learned": 0.9, "matched": 0.9})
    (weak,) = weaknesses([dataclasses.replace(one, ap={**one.ap, "matched": 0.55}), best])
    assert weak.gain == pytest.approx(0.32) and weak.reason.startswith("bin 2 has 90; ")
    assert "a larger share hardly" in weak.reason


def test_what_was_forgotten_is_certain_and_ordered_by_what_it_costs():
    bins, labels = torch.tensor([0] * 24 + [1] * 6 + [2] * 6), torch.zeros(36).long()
    before, after = torch.ones(36, dtype=torch.bool), torch.ones(36, dtype=torch.bool)
    after[:24], after[24:30] = torch.arange(24) % 3 > 0, False
    after[30] = False  # one of six is no certain loss
    found, test = (
        {"ns": detections(labels, before), "learned": detections(labels, after)},
        images(bins, labels),
    )
    lost = forgotten(bin_scores(["a"], found, test), ["a"], found, test)
    assert [one.score.bin for one in lost] == [1, 2] and lost[1].loss.value == pytest.approx(1.0)
    assert 0.0 < lost[0].loss.low < lost[0].loss.value < lost[0].loss.high < 0.6
    assert (
        forgotten(
            bin_scores(["a"], {"ns": found["learned"], "learned": found["ns"]}, test), ["a"], found, test
        )
        == []
    )


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
