"""Pareto-optimal settings, defaults that are beaten, observed orders, timings."""

import itertools
import math
import time

import pytest
import torch

from neural_sim.studies.work_precision.measurement import Point, Series, Timing, pareto, slope


def test_pareto_by_definition():
    costs = [
        (1.0, 5.0),
        (2.0, 2.0),
        (3.0, 3.0),
        (2.0, 4.0),
        (5.0, 1.0),
        (5.0, 1.0),
        (math.nan, 0.1),
        (0.0, math.inf),
    ]
    assert pareto(costs) == (True, True, False, False, True, True, False, False)
    assert pareto([]) == ()


def test_pareto_agrees_with_every_pair_for_random_costs():
    drawn = torch.randint(0, 6, (60, 2), generator=torch.Generator().manual_seed(0)).double().tolist()
    found = pareto([(a, b) for a, b in drawn])
    for i, (error, seconds) in enumerate(drawn):
        beaten = any(
            (e < error and s <= seconds) or (e <= error and s < seconds)
            for j, (e, s) in enumerate(drawn)
            if j != i
        )
        assert found[i] is not beaten
    # No point of the front lies below and left of another.
    front = [cost for cost, best in zip(drawn, found, strict=True) if best]
    assert all(a == b or (a[0] < b[0]) != (a[1] < b[1]) for a, b in itertools.combinations(front, 2))


def test_a_default_is_beaten_only_beyond_the_noise_of_timings():
    def series(*points):
        return Series("a/b", "error", points)

    mine = Point("mine", 1.0, 10.0, default=True)
    assert [o.setting for _, o in series(mine, Point("x", 1.0, 8.9), Point("y", 0.5, 8.0)).overtaken()] == [
        "y"
    ]
    assert not list(series(mine, Point("slightly faster", 1.0, 9.5)).overtaken())
    assert not list(series(mine, Point("worse", 1.1, 1.0)).overtaken())
    assert not list(series(Point("plain", 1.0, 10.0), Point("x", 0.5, 1.0)).overtaken())
    assert series(mine, Point("slightly faster", 1.0, 9.5)).pareto == (False, True)


def test_series_refuse_what_cannot_be_told_apart_or_measured():
    with pytest.raises(ValueError, match=r"a/b: want settings that differ"):
        Series("a/b", "error", (Point("x", 1.0, 1.0), Point("x", 2.0, 1.0)))
    with pytest.raises(ValueError, match=r"a/b: want settings"):
        Series("a/b", "error", ())
    with pytest.raises(ValueError, match=r"at least 0"):
        Series("a/b", "error", (Point("x", -1.0, 1.0),))


def test_slope_of_a_power_law_is_its_exponent():
    steps = [0.5**k for k in range(5)]
    assert slope(steps, [3.0 * h**1.5 for h in steps]) == pytest.approx(1.5, abs=1e-12)
    assert math.isnan(slope(steps[:1], [1.0])) and math.isnan(slope([1.0, 2.0], [0.0, 1.0]))
    with pytest.raises(ValueError, match="positive step"):
        slope([1.0, 0.0], [1.0, 1.0])


def test_timings_count_each_run_once_by_their_clock():
    calls = []

    def sleep():
        calls.append(torch.zeros(2**18))
        time.sleep(0.03)

    wall, memory = Timing(2, "seconds").of(sleep)
    assert 0.03 <= wall < 1.0 and memory >= 1.0
    calls.clear()
    cpu, _ = Timing(2, "cpu_seconds").of(sleep)
    assert cpu < 0.5 * wall  # sleep takes no processor time
    for wrong in ({"repeats": 0}, {"clock": "sundial"}):
        with pytest.raises(ValueError, match=rf"Timing\.{next(iter(wrong))}"):
            Timing(**wrong)
