"""Differences between methods, and whether they exceed the spread over seeds and test images.

All methods of a seed are scored on one test set, so that they are compared in pairs, seed by seed and image by image.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import class_scores, mean_of_known
from neural_sim.report.finished import FinishedRun
from neural_sim.report.intervals import Estimate, Sample, over_seeds, over_seeds_and_images, ratio

BOUNDS = ("ns", "matched")
"""Detectors that every run of a seed has, and that do not depend on its method. They stand for the methods ``ns`` and
``oracle``, whose own runs are not compared again. The second is missing where the target's distribution is not known.
"""
FIXED = ("ns", "oracle")
BUDGETS = 6
"""Seconds at which the methods are compared, evenly spaced in their logarithm."""
ONLY_AT_END = (
    "Some runs were scored at their end alone and count as their start until then, so that areas, and scores and leads "
    "after fewer seconds, do not tell who is ahead: score_at=[0.25,0.5] scores a run on its way, too."
)
Clock = Literal["seconds", "cpu_seconds"]
"""What a method has taken: by the clock on the wall, or of all processor cores together."""


@dataclass(frozen=True)
class Comparison:
    """The methods of one setting over the seeds that all of them have.

    ``ap`` is the biased objects' mean AP, of ``bounds`` too; ``won_back`` the fraction of the gap from ns to matched,
    empty without matched, and where the start is the target's and there is no gap; ``ahead`` the reference method's AP
    minus each other's, ``area`` the difference of their areas under AP against log seconds, per unit of log seconds, by
    ``clock``. ``at_equal_cost`` is every method's AP at the seconds that the cheapest of them
    took in all (their mean over seeds is ``equal_cost``), see :func:`ap_at`; ``ahead_at`` is the reference method's
    lead over each other one at each of ``budgets`` seconds, which reach from the first scored iteration of any run to
    the last; a method that has ended by then keeps its last AP. ``spent`` are means over seeds, with the warm start.
    Where ``score`` is accuracy, that stands in the place of AP. With ``only_at_end`` some run was scored once: it
    counts as its start until its end, and what is read at fewer seconds does not tell who is ahead.
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
    only_at_end: bool = False

    @property
    def several(self) -> bool:
        """Whether intervals are over seeds, so that differences that leave 0 out exceed the spread."""
        return len(self.seeds) > 1

    @property
    def timed(self) -> bool:
        """The same of what is read at fewer seconds than a run took."""
        return self.several and not self.only_at_end

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
    matches = [
        [table[reference, s].matches[bound] for bound in bounds]
        + [table[method, s].matches["learned"] for method in methods]
        for s in seeds
    ]
    point, spread = (mean_of_known(scores) for scores in class_scores(matches, draws, seed))
    of = {name: (point[:, i], spread[..., i]) for i, name in enumerate((*bounds, *methods))}
    ap = {name: over_seeds_and_images(*own).as_fraction for name, own in of.items()}
    won = {}
    if "matched" in bounds:
        gap = _minus(of["matched"], of["ns"])
        each = {m: ratio(_minus(of[m], of["ns"]), gap) for m in methods}
        won = {m: fraction for m, fraction in each.items() if not math.isnan(fraction.value)}
    ahead = {m: over_seeds_and_images(*_minus(of[reference], of[m])) for m in methods[1:]}
    return Comparison(
        runs[0].setting, seeds, methods, reference, ap, won,
        ahead, _areas(table, seeds, methods, clock),
        {m: {k: _mean(table[m, s].spent(k) for s in seeds) for k in ("images", "detector_steps", "products", clock)}
         for m in methods}, *_at_equal_cost(table, seeds, methods, clock),
        *_ahead_at(table, seeds, methods, clock), clock, runs[0].score,
        any((biased_ap(table[m, s], clock)[0] > 0.0).sum() == 1 for m in methods for s in seeds),
    )  # fmt: skip


def _minus(a: Sample, b: Sample) -> Sample:
    return a[0] - b[0], a[1] - b[1]


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
    clock: Clock,
) -> tuple[dict[str, Estimate], float]:
    """Every method's AP at the least seconds that any of them took in all, seed by seed, and those seconds' mean."""
    curves = {
        key: biased_ap(run, clock) for key, run in table.items() if key[1] in seeds and key[0] in methods
    }
    ends = {s: [curves[m, s][0][-1] for m in methods if curves[m, s][0][-1] > 0.0] for s in seeds}
    budgets = {s: min(end, default=0.0) for s, end in ends.items()}
    reached = {m: [ap_at(*curves[m, s], budgets[s]) for s in seeds] for m in methods}
    at = {m: over_seeds(np.asarray(own)).as_fraction for m, own in reached.items()}
    return at, _mean(budgets.values())


def _ahead_at(
    table: Mapping[tuple[str, int], FinishedRun],
    seeds: Sequence[int],
    methods: Sequence[str],
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
        for method, own in ahead.items():
            own.append(over_seeds(np.asarray([reached[methods[0], s] - reached[method, s] for s in seeds])))
    return budgets, ahead


def _areas(
    table: Mapping[tuple[str, int], FinishedRun],
    seeds: Sequence[int],
    methods: Sequence[str],
    clock: Clock,
) -> dict[str, Estimate]:
    curves = {key: biased_ap(run, clock) for key, run in table.items() if key[1] in seeds}
    spent = [times[times > 0.0] for times, _ in curves.values()]
    starts, ends = [t.min() for t in spent if len(t)], [t.max() for t in spent if len(t)]
    if not starts or min(starts) >= max(ends):
        return {}
    areas = {key: area_under(*curve, min(starts), max(ends)) for key, curve in curves.items()}
    return {
        m: over_seeds(np.asarray([areas[methods[0], s] - areas[m, s] for s in seeds])) for m in methods[1:]
    }


def _mean(values) -> float:
    return float(np.mean(list(values)))
