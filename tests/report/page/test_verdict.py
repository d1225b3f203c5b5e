"""The verdict on detections whose AP is known: better, worse, no difference, and against the target's own."""

import pytest
import torch

from neural_sim.report.intervals import Estimate, bounds
from neural_sim.report.page.run_page import Shown, score_table
from neural_sim.report.page.verdict import Gain, listed, verdict
from neural_sim.types import LabelledImages

IMAGES = 40
BOX = torch.tensor([[2.0, 2.0, 10.0, 10.0]])
TEST = LabelledImages(
    torch.zeros(IMAGES, 3, 12, 12),
    BOX.expand(IMAGES, 1, 4),
    torch.zeros(IMAGES, 1).long(),
    torch.zeros(IMAGES).long(),
)


def detections(hits):
    """Exact detections on the first ``hits`` images and none on the others: AP is about that fraction."""
    one = {"boxes": BOX, "labels": torch.zeros(1).long(), "scores": torch.ones(1)}
    none = {key: value[:0] for key, value in one.items()}
    return [one] * hits + [none] * (IMAGES - hits)


def gain(ns, learned, matched, same=False):
    found = {"ns": detections(ns), "learned": detections(learned), "matched": detections(matched)}
    return Gain.of(table(found).of_classes(["mug"]), same)


def table(found):
    return score_table(Shown(TEST, TEST, TEST, found), ["mug", "can"], "AP")


def test_a_gain_is_the_difference_of_ap_and_its_fraction_of_the_room():
    better = gain(8, 24, 32)
    assert better.gain.value == pytest.approx(0.4, abs=0.02) and better.outcome == "better"
    assert better.gain.low < better.gain.value < better.gain.high
    # The binomial interval of 24 - 8 of 40 images: 0.4 +- 1.96 sqrt(0.4 0.6 / 40).
    assert better.gain.low == pytest.approx(0.4 - 1.96 * (0.4 * 0.6 / 40) ** 0.5, abs=0.06)
    assert better.closed == pytest.approx(16 / 24, abs=0.03)
    text = verdict(better, trainings=2)
    assert text.startswith("It worked") and "on mug" in text and f"{better.closed:.0%}" in text
    one = verdict(better)
    assert (
        one.startswith("With one training on each distribution, the learned one gave")
        and "more on mug" in one
    )
    assert f"({bounds(better.gain)} over test images), from" in one and f"{better.closed:.0%}" in one


def test_a_gain_without_a_known_target_has_no_room():
    found = {"ns": detections(8), "learned": detections(24)}
    alone, beside = Gain.of(table(found).of_classes(["mug"])), gain(8, 24, 32)
    assert alone.gain == beside.gain and alone.room is None and alone.closed is None
    assert verdict(alone).endswith(f"to {100 * alone.ap['learned']:.1f}.")


def test_a_class_without_boxes_is_in_no_mean():
    found = {"ns": detections(8), "learned": detections(24), "matched": detections(32)}
    both = table(found)
    assert both.shown == ["mug"] and Gain.of(both).gain == gain(8, 24, 32).gain


def test_a_loss_is_called_one():
    worse = gain(24, 8, 32)
    assert worse.outcome == "worse" and verdict(worse, trainings=2).startswith("It made things worse")
    lost, least, most = (-100 * value for value in (worse.gain.value, worse.gain.high, worse.gain.low))
    several, one = verdict(worse, trainings=2), verdict(worse)
    assert f"costs {lost:.1f} AP on mug ({least:.1f} to {most:.1f})." in several and 0 < least < most
    assert one.startswith("With one training on each distribution") and "worse" not in one
    assert f"gave {lost:.1f} AP less on mug ({least:.1f} to {most:.1f} over test images)." in one


def test_what_cannot_be_told_is_not_claimed():
    none = gain(20, 20, 20)
    assert none.outcome == "no difference" and none.closed is None
    assert verdict(none).startswith("No difference can be seen") and "would give +0.0" in verdict(none)


def test_without_a_gap_the_target_is_not_mentioned():
    alone = gain(8, 24, 8, same=True)
    assert alone.room is None and "target" not in verdict(alone)
    assert "not known" in verdict(None)


def test_lists_and_intervals_read_as_sentences_do():
    assert [listed(["a"]), listed(["a", "b"]), listed(["a", "b", "c"])] == ["a", "a and b", "a, b and c"]
    assert bounds(Estimate(0.1, -0.0001, 0.152)) == "0.0 to 15.2"
    assert bounds(Estimate(0.1, 0.05, 0.152)) == "5.0 to 15.2" and bounds(Estimate(0.1)) == "no interval"
