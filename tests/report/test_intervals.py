"""Intervals over few seeds against scipy's, against closed forms, and by how often they contain the truth."""

import math

import numpy as np
import pytest
from scipy.stats import norm, ttest_1samp

from neural_sim.report.intervals import Estimate, over_images, over_seeds, over_seeds_and_images, ratio

VALUES = np.array([0.3, 0.7, 0.4])
STILL = np.zeros((50, 1))


def bounds(estimate):
    return estimate.low, estimate.high


def around(values, over, draws=20_000, shared=True, seed=0):
    """Resampled values: normal about ``values``, the same for all seeds or each its own."""
    random = np.random.default_rng(seed)
    return values + random.normal(0.0, over, (draws, 1 if shared else len(values)))


@pytest.mark.parametrize("found", [over_seeds, lambda v: over_seeds_and_images(v, v + STILL)])
def test_without_images_the_interval_is_that_of_students_test(found):
    expected = ttest_1samp(VALUES, 0.0).confidence_interval(0.95)
    assert found(VALUES).value == pytest.approx(VALUES.mean())
    assert bounds(found(VALUES)) == pytest.approx((expected.low, expected.high))


def test_the_interval_of_a_fraction_ends_where_fractions_do():
    assert Estimate(0.1, -0.2, 0.4).as_fraction == Estimate(0.1, 0.0, 0.4)
    assert Estimate(0.9, 0.7, 1.1).as_fraction == Estimate(0.9, 0.7, 1.0)
    assert Estimate(0.9).as_fraction == Estimate(0.9)


def test_one_seed_has_quantiles_over_images_or_no_interval():
    one = np.array([0.4])
    assert over_seeds(one) == Estimate(0.4) and not over_seeds(one).certain
    drawn = around(one, 0.1)
    assert over_seeds_and_images(one, drawn) == over_images(0.4, drawn[:, 0])
    assert bounds(over_images(0.4, drawn[:, 0])) == pytest.approx((0.4 - 0.196, 0.4 + 0.196), abs=0.01)


def test_images_that_all_seeds_share_add_their_part_whatever_the_number_of_seeds():
    for n in (2, 8):
        equal = np.full(n, 0.5)
        found = over_seeds_and_images(equal, around(equal, 0.1))
        assert bounds(found) == pytest.approx((0.5 - 0.196, 0.5 + 0.196), abs=0.005)
    both = over_seeds_and_images(VALUES, around(VALUES, 0.1))
    alone = over_seeds(VALUES).high - VALUES.mean()
    assert both.high - both.value == pytest.approx(math.hypot(alone, 0.196), rel=0.01)


def test_draws_without_a_box_stay_out():
    drawn = around(VALUES, 0.1)
    gaps = drawn.copy()
    gaps[::2, 1] = math.nan
    assert bounds(over_seeds_and_images(VALUES, gaps)) == pytest.approx(
        bounds(over_seeds_and_images(VALUES, drawn)), abs=0.005
    )


@pytest.mark.parametrize(("seeds", "shared"), [(2, False), (3, False), (3, True), (6, True)])
def test_intervals_contain_the_truth_at_least_as_often_as_they_say(seeds, shared):
    random, runs, inside = np.random.default_rng(seeds), 1000, 0
    for _ in range(runs):
        images = random.normal(0.0, 0.9, 1 if shared else seeds)
        values = random.normal(0.0, 1.6, seeds) + images
        drawn = values + random.normal(0.0, 0.9, (100, 1 if shared else seeds))
        found = over_seeds_and_images(values, drawn)
        inside += found.low <= 0.0 <= found.high
    # Three standard errors of a count below 95 %; it is at most about 98 %.
    assert 0.95 - 3 * (0.95 * 0.05 / runs) ** 0.5 <= inside / runs < 0.995


def test_a_ratio_lies_where_students_test_does_not_reject_it():
    gap, gain = np.array([0.30, 0.36, 0.33]), np.array([0.28, 0.30, 0.33])
    found = ratio((gain, gain + STILL), (gap, gap + STILL))
    assert found.value == pytest.approx(gain.mean() / gap.mean())
    for bound in bounds(found):
        assert ttest_1samp(gain - bound * gap, 0.0).pvalue == pytest.approx(0.05, abs=1e-6)
    assert ttest_1samp(gain - found.value * gap, 0.0).pvalue == pytest.approx(1.0)
    assert found.low < found.value < found.high


def test_a_ratio_of_one_seed_lies_where_the_images_do_not_reject_it():
    random = np.random.default_rng(1)
    gains, gaps = (at + random.normal(0.0, 0.02, (500, 1)) for at in (0.2, 0.3))
    found = ratio((np.array([0.2]), gains), (np.array([0.3]), gaps))
    for bound in bounds(found):
        z = (0.2 - bound * 0.3) / (gains - bound * gaps).std(ddof=1)
        assert 2 * norm.sf(abs(z)) == pytest.approx(0.05, abs=1e-6)


def test_a_ratio_to_what_is_not_told_from_nothing_has_no_interval():
    gap = np.array([0.1, -0.05, 0.02])
    found = ratio((2.0 * gap, 2.0 * gap + STILL), (gap, gap + STILL))
    assert found.value == pytest.approx(2.0) and bounds(found) == (None, None)
    nothing = np.zeros(3)
    assert math.isnan(ratio((gap, gap + STILL), (nothing, nothing + STILL)).value)


def test_where_almost_no_draw_shows_a_box_there_is_no_interval():
    """No bounds, rather than bounds that are not numbers."""
    values, bare = np.array([0.5, 0.75]), np.array([[0.5, 0.75], [np.nan, np.nan]])
    assert over_seeds_and_images(values, bare) == Estimate(0.625)
    assert over_seeds_and_images(values[:1], bare[1:, :1]) == Estimate(0.5)
    assert ratio((values, bare), (np.array([0.5, 1.0]), bare)) == Estimate(pytest.approx(0.625 / 0.75))


def test_all_that_is_gained_of_a_gap_is_certain_though_the_gap_varies():
    gap = np.array([0.2, 0.3, 0.4])
    found = ratio((gap, around(gap, 0.01)), (gap, around(gap, 0.01)))
    assert (found.value, *bounds(found)) == pytest.approx((1.0, 1.0, 1.0))
