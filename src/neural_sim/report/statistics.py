"""Differences between methods, and whether they exceed the spread over seeds and test images.

All methods of a seed are scored on one test set, so that they are compared in pairs: a bootstrap draw takes the same
seeds and the same images for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import Outcomes, class_score
from neural_sim.report.finished import FinishedRun

BOUNDS = ("ns", "matched")
"""Detectors that every run of a seed has, and that do not depend on its method. They stand for the methods ``ns`` and
``oracle``, whose own runs are not compared again. The second is missing where the target's distribution is not known.
"""
FIXED = ("ns", "oracle")
BUDGETS = 6
"""Seconds at which the methods are compared, evenly spaced in their logarithm."""
Clock = Literal["seconds", "cpu_seconds"]
"""What a method has taken: by the clock on the wall, or of all processor cores together."""


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % bootstrap interval, None where there is nothing to resample."""

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def certain(self) -> bool:
        """Whether there is an interval, and leaves 0 out."""
        return self.low is not None and self.high is not None and (self.low > 0.0 or self.high < 0.0)


@dataclass(frozen=True)
class Comparison:
    """The methods of one setting over the seeds that all of them have.

    ``ap`` is the biased objects' mean AP, of ``bounds`` too; ``won_back`` the fraction of the gap from ns to matched,
    empty without matched; ``ahead`` the
    reference method's AP minus each other's, ``area`` the difference of their areas under AP against log seconds, per
    unit of log seconds, by ``clock``. ``at_equal_cost`` is every method's AP at the seconds that the cheapest of them
    took in all (their mean over seeds is ``equal_cost``), see :func:`ap_at`; ``ahead_at`` is the reference method's
    lead over each other one at each of ``budgets`` seconds, which reach from the first scored iteration of any run to
    the last; a method that has ended by then keeps its last AP. ``spent`` are means over seeds, with the warm start.
    Where ``score`` is accuracy, that stands in the place of AP.
    """

    setting: str
    seeds: tuple[int, ...]
    methods: tuple[str, ...]
    reference: str
    ap: Mapping[str, Estimate]
    won_back: Mapping[str, Estimate]
    ahead: Mapping[str, Estimate]
    area: Mapping[str, Estimate]
    spent: Mapping[str, Mapping[str, float]]
    at_equal_cost: Mapping[str, Estimate]
    equal_cost: float
    budgets: Sequence[float] = ()
    ahead_at: Mapping[str, Sequence[Estimate]] = field(default_factory=dict)
    clock: Clock = "seconds"
    score: Score = "AP"

    @property
    def bounds(self) -> list[str]:
        """The detectors of ``BOUNDS`` that the runs have."""
        return [bound for bound in BOUNDS if bound in self.ap]


def compare(
    runs: Sequence[FinishedRun], reference: str, draws: int, seed: int = 0, clock: Clock = "seconds"
) -> Comparison:
    """Compare the runs of one setting.

    Raises:
        ValueError: the reference has no run, or no seed is common to all methods.
    """
    methods = {run.method for run in runs} - set(FIXED) | {reference}
    methods = tuple(sorted(methods, key=lambda m: (m != reference, m)))
    table = {(run.method, run.seed): run for run in runs}
    if not any(method == reference for method, _ in table):
        raise ValueError(f"compare.reference: no run of {reference!r}, got {sorted({m for m, _ in table})}")
    seeds = tuple(sorted({s for _, s in table if all((method, s) in table for method in methods)}))
    if not seeds:
        raise ValueError(f"compare: no seed is common to {', '.join(methods)} in {runs[0].setting}")
    bounds = [bound for bound in BOUNDS if all(bound in table[reference, s].matches for s in seeds)]
    columns, first = (*bounds, *methods), len(bounds)
    matches = [
        [table[reference, s].matches[bound] for bound in bounds]
        + [table[method, s].matches["learned"] for method in methods]
        for s in seeds
    ]
    point = np.asarray([[mean_ap(classes) for classes in row] for row in matches]).mean(0)
    spread = resampled(matches, draws, seed)
    ap = dict(zip(columns, with_intervals(point, spread), strict=True))
    won = {}
    if "matched" in bounds:
        gap, spread_gap = point[1] - point[0], spread[:, 1] - spread[:, 0]
        parts = (point[first:] - point[0]) / gap, (spread[:, first:] - spread[:, :1]) / spread_gap[:, None]
        won = dict(zip(methods, with_intervals(*parts), strict=True))
    ours, others = slice(first, first + 1), slice(first + 1, None)
    ahead = with_intervals(point[ours] - point[others], spread[:, ours] - spread[:, others])
    return Comparison(
        runs[0].setting, seeds, methods, reference, ap, won,
        dict(zip(methods[1:], ahead, strict=True)), _areas(table, seeds, methods, draws, seed, clock),
        {m: {k: _mean(table[m, s].spent(k) for s in seeds) for k in ("images", "detector_steps", "products", clock)}
         for m in methods}, *_at_equal_cost(table, seeds, methods, draws, seed, clock),
        *_ahead_at(table, seeds, methods, draws, seed, clock), clock, runs[0].score,
    )  # fmt: skip


def mean_ap(matches: Sequence[Outcomes], weights: Float[np.ndarray, "images"] | None = None) -> float:
    """Mean over classes; those without a box among the weighted images stay out of it."""
    known = [ap for m in matches if not math.isnan(ap := class_score(m, weights))]
    return float(np.mean(known)) if known else math.nan


def resampled(
    matches: Sequence[Sequence[Sequence[Outcomes]]], draws: int, seed: int
) -> Float[np.ndarray, "draws columns"]:
    """Mean AP of each column of ``matches`` [seeds][columns][classes] under resampled seeds and images."""
    random, rows = np.random.default_rng(seed), []
    for _ in range(draws):
        each = []
        for i in random.integers(len(matches), size=len(matches)):
            count = len(matches[i][0][0].boxes_per_image)
            weights = np.bincount(random.integers(count, size=count), minlength=count).astype(float)
            each.append([mean_ap(classes, weights) for classes in matches[i]])
        rows.append(np.mean(each, 0))
    return np.asarray(rows)


def biased_ap(
    run: FinishedRun, clock: Clock
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]:
    """Seconds spent by a clock, and the biased objects' mean AP, at every iteration that was scored."""
    curve, biased = run.results["curve"], run.results["biased"]
    ap = [_mean(point["ap"]["per_class"][name] for name in biased) for point in curve]
    return np.asarray([point[clock] for point in curve]), np.asarray(ap)


def area_under(
    seconds: Float[np.ndarray, "points"], ap: Float[np.ndarray, "points"], first: float, last: float
) -> float:
    """Mean of AP over log seconds in [first, last], AP as :func:`ap_at` has it at every budget."""
    begun = seconds > 0.0
    if not begun.any():
        return float(ap[0])
    lower, upper, points = math.log(first), math.log(last), np.log(seconds[begun])
    start = min(max(points[0], lower), upper)
    edges = np.concatenate([[start], points[(points > start) & (points < upper)], [upper]])
    line = np.trapezoid(np.interp(edges, points, ap[begun]), edges)
    return float(ap[0] * (start - lower) + line) / (upper - lower)


def ap_at(seconds: Float[np.ndarray, "points"], ap: Float[np.ndarray, "points"], budget: float) -> float:
    """AP at a budget of seconds: linear in log seconds between scored points, the start's until the first of them."""
    begun = seconds > 0.0
    if not begun.any() or budget < seconds[begun][0]:
        return float(ap[0])
    return float(np.interp(math.log(budget), np.log(seconds[begun]), ap[begun]))


def _at_equal_cost(
    table: Mapping[tuple[str, int], FinishedRun],
    seeds: Sequence[int],
    methods: Sequence[str],
    draws: int,
    seed: int,
    clock: Clock,
) -> tuple[dict[str, Estimate], float]:
    """Every method's AP at the least seconds that any of them took in all, seed by seed, and those seconds' mean."""
    curves = {
        key: biased_ap(run, clock) for key, run in table.items() if key[1] in seeds and key[0] in methods
    }
    ends = {s: [curves[m, s][0][-1] for m in methods if curves[m, s][0][-1] > 0.0] for s in seeds}
    budgets = {s: min(end, default=0.0) for s, end in ends.items()}
    reached = {m: [ap_at(*curves[m, s], budgets[s]) for s in seeds] for m in methods}
    return over_seeds(reached, draws, seed), _mean(budgets.values())


def _ahead_at(
    table: Mapping[tuple[str, int], FinishedRun],
    seeds: Sequence[int],
    methods: Sequence[str],
    draws: int,
    seed: int,
    clock: Clock,
) -> tuple[list[float], dict[str, list[Estimate]]]:
    """Budgets of seconds, and the first method's lead over each other one at each of them."""
    curves = {(m, s): biased_ap(table[m, s], clock) for m in methods for s in seeds}
    spent = np.concatenate([times[times > 0.0] for times, _ in curves.values()])
    if not len(spent):
        return [], {}
    budgets = np.unique(np.geomspace(spent.min(), spent.max(), BUDGETS)).tolist()
    ahead: dict[str, list[Estimate]] = {m: [] for m in methods[1:]}
    for budget in budgets:
        reached = {key: ap_at(*curve, budget) for key, curve in curves.items()}
        leads = {m: [reached[methods[0], s] - reached[m, s] for s in seeds] for m in methods[1:]}
        for method, lead in over_seeds(leads, draws, seed).items():
            ahead[method].append(lead)
    return budgets, ahead


def _areas(
    table: Mapping[tuple[str, int], FinishedRun],
    seeds: Sequence[int],
    methods: Sequence[str],
    draws: int,
    seed: int,
    clock: Clock,
) -> dict[str, Estimate]:
    curves = {key: biased_ap(run, clock) for key, run in table.items() if key[1] in seeds}
    spent = [times[times > 0.0] for times, _ in curves.values()]
    starts, ends = [t.min() for t in spent if len(t)], [t.max() for t in spent if len(t)]
    if not starts or min(starts) >= max(ends):
        return {}
    areas = {key: area_under(*curve, min(starts), max(ends)) for key, curve in curves.items()}
    ahead = {m: [areas[methods[0], s] - areas[m, s] for s in seeds] for m in methods[1:]}
    return over_seeds(ahead, draws, seed)


def over_seeds(values: Mapping[str, Sequence[float]], draws: int, seed: int) -> dict[str, Estimate]:
    """Means over seeds of numbers by name; seeds alone are resampled. One seed has no interval."""
    found = {}
    for method, each in values.items():
        numbers, random = np.asarray(each), np.random.default_rng(seed)
        chosen = random.integers(len(each), size=(draws, len(each)))
        found[method] = with_intervals(numbers.mean(keepdims=True), numbers[chosen].mean(1, keepdims=True))[0]
        if len(each) == 1:
            found[method] = Estimate(found[method].value)
    return found


def with_intervals(
    point: Float[np.ndarray, "columns"], spread: Float[np.ndarray, "draws columns"]
) -> list[Estimate]:
    """Of each column: its value, and the 2.5 % and 97.5 % quantiles of its resampled values, nan left out."""
    if not len(point):  # of which nanquantile has no bounds
        return []
    low, high = np.nanquantile(spread, [0.025, 0.975], axis=0)
    return [Estimate(float(p), float(a), float(b)) for p, a, b in zip(point, low, high, strict=True)]


def _mean(values) -> float:
    return float(np.mean(list(values)))
