"""The table of scores, on made-up outcomes whose scores are known."""

import numpy as np
import pytest

from neural_sim.report.bootstrap import THRESHOLDS, Matches, average_precision
from neural_sim.report.score_table import ScoreTable

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


def test_scatter_is_a_standard_deviation_between_seeds_and_over_images():
    made = table(200, ns=[(0.4, 0.4), (0.6, 0.6)], learned=[(0.5, 0.5), (0.5, 0.5)])
    (low, high), found = made.sample("ns")[0], made.scatter()
    assert found.seeds == pytest.approx((0.5 * (high - low) ** 2 / 2) ** 0.5, rel=1e-6)
    # The mean of two classes of independent hits: sqrt(0.25 / 40 / 2).
    assert found.images == pytest.approx((0.25 / IMAGES / 2) ** 0.5, rel=0.25)
