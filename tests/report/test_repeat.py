"""Means, scatter and intervals of trainings whose scores are known."""

import numpy as np
import pytest
from finished_runs import IMAGES, matches
from scipy.stats import t as student

from neural_sim.report.bootstrap import THRESHOLDS, Matches
from neural_sim.report.repeat import repeated, sentence, table

NONE = Matches(
    np.zeros(0, dtype=int), np.zeros((0, len(THRESHOLDS)), dtype=bool), np.zeros(IMAGES, dtype=int)
)
T2 = student.ppf(0.975, 2)


def overlapping(tenths):
    """Every image has one detection, whose overlap is right at ``tenths`` of the ten thresholds from 0.5: AP is that
    fraction, whichever images are drawn."""
    correct = np.tile(np.arange(len(THRESHOLDS)) < tenths, (IMAGES, 1))
    return Matches(np.arange(IMAGES), correct, np.ones(IMAGES, dtype=int))


def of(groups=((["mug"], [0]),), **trainings):
    """By distribution, from each training's matches of the first class; the second has no box."""
    return repeated({w: [[m, NONE] for m in each] for w, each in trainings.items()}, groups, draws=400)


def half(estimate):
    return (estimate.high - estimate.low) / 2


def test_the_mean_of_trainings_has_students_interval_where_images_do_not_matter():
    (found,) = of(ns=map(overlapping, (4, 5, 6)), learned=map(overlapping, (6, 8, 7)))
    assert found.scores["ns"] == pytest.approx([0.4, 0.5, 0.6], abs=0.005)
    assert found.mean["learned"].value == pytest.approx(0.7, abs=0.005)
    assert half(found.mean["ns"]) == pytest.approx(T2 * 0.1 / 3**0.5, rel=0.02)
    assert found.between == pytest.approx(0.1, rel=0.02) and found.over_images == pytest.approx(0.0, abs=1e-9)
    # Training by training: 0.2, 0.3, 0.1.
    assert found.ahead["learned", "ns"].value == pytest.approx(0.2, abs=0.005)
    assert half(found.ahead["learned", "ns"]) == pytest.approx(T2 * 0.1 / 3**0.5, rel=0.02)
    assert not found.ahead["learned", "ns"].certain and "No difference can be told" in sentence(found, "AP")


def test_what_all_trainings_gain_is_certain_however_they_scatter():
    (found,) = of(ns=map(overlapping, (2, 5, 8)), learned=map(overlapping, (4, 7, 10)))
    assert found.ahead["learned", "ns"].certain and half(found.ahead["learned", "ns"]) < 0.01
    assert (found.mean["learned"].low, found.mean["learned"].high) == (0.0, 1.0)  # any score
    assert sentence(found, "AP").startswith("After 3 trainings of each distribution: It worked")


def test_the_scatter_over_images_does_not_shrink_with_the_number_of_trainings():
    few, many = (of(ns=[matches(0.5)] * n, learned=[matches(0.75)] * n)[0] for n in (2, 6))
    binomial = (0.5 * 0.5 / IMAGES) ** 0.5
    for found in (few, many):
        assert half(found.mean["ns"]) == pytest.approx(1.96 * binomial, rel=0.15)
        assert found.between < 1e-12 and found.over_images == pytest.approx(binomial, rel=0.15)
        # A quarter of the images tells them apart.
        assert half(found.ahead["learned", "ns"]) == pytest.approx(
            1.96 * (0.25 * 0.75 / IMAGES) ** 0.5, rel=0.15
        )


def test_both_parts_add_as_squares():
    (found,) = of(ns=map(matches, (0.4, 0.5, 0.6)), learned=[matches(0.5)] * 3)
    images = half(found.mean["learned"])
    assert half(found.mean["ns"]) == pytest.approx((images**2 + (T2 * 0.1) ** 2 / 3) ** 0.5, rel=0.1)


def test_a_class_without_boxes_is_in_no_mean_and_the_target_sets_the_room():
    groups = ((["mug"], [0]), (["mug", "can"], [0, 1]))
    alone, both = of(
        groups,
        ns=map(overlapping, (4, 4)),
        learned=map(overlapping, (6, 6)),
        matched=map(overlapping, (8, 8)),
    )
    assert both.mean == alone.mean and both.ahead == alone.ahead
    assert alone.gain.closed == pytest.approx(0.5, abs=0.01)
    rows = table([alone, both], "AP").splitlines()
    assert [row.split(" | ")[0] for row in rows[2:4]] == ["| mug", "| mean of mug, can"]
    assert "**20.0** (20.0 to 20.0)" in rows[2] and "means of 2 trainings" in rows[-1]


@pytest.mark.parametrize("counts", [(1, 1), (2, 3)])
def test_trainings_that_tell_no_scatter_are_refused(counts):
    with pytest.raises(ValueError, match="want two trainings or more"):
        of(ns=[matches(0.5)] * counts[0], learned=[matches(0.5)] * counts[1])
