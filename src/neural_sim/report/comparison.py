"""Compare the methods of one setting: scores at the end, at equal cost and over time, leads, and costs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean, median
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from neural_sim.detector.metrics import mean_over
from neural_sim.detector.protocol import Score
from neural_sim.documents import markdown_table
from neural_sim.report.intervals import Estimate, over_seeds
from neural_sim.report.runs import BOUNDS, FinishedRun, common_seeds, methods_of, score_table
from neural_sim.report.tracking import UNKNOWN

BUDGETS = 6
"""Number of times at which the methods are compared, evenly spaced in log seconds."""
ONLY_AT_END = (
    "Some runs were scored only at their start and their end. Until the end, they count with the score of their start, "
    "so areas, and scores and leads after fewer seconds, do not show which method is ahead. With "
    "score_at=[0.25,0.5], a run is also scored on its way."
)
SPENT = ("images", "detector_steps", "products")
Clock = Literal["seconds", "cpu_seconds"]
"""How a method's time is measured: wall-clock seconds, or processor seconds over all cores."""


@dataclass(frozen=True)
class Comparison:
    """A comparison of the methods of one setting, over the seeds that all of them have.

    Scores are means over the biased objects. If some run was scored only at its start and end (``only_at_end``), scores
    and leads before the end do not show which method is ahead.

    Args:
        setting: the experiment and its gap.
        seeds: the seeds that all methods have.
        methods: the methods, the reference first.
        reference: the method that the others are compared with.
        ap: the score of every method and of ``bounds``.
        won_back: the fraction of the gap from ns to matched that a method closes; empty without matched, or if there is
            no gap because the initial distribution is the target's.
        ahead: the reference's score minus each other method's.
        area: the same difference for the areas under the score against log seconds, per unit of log seconds.
        spent: the total cost of every method, including the warm start, means over seeds.
        at_equal_cost: the score after the total seconds of the cheapest method, see ``ap_at``.
        equal_cost: these seconds, averaged over seeds.
        budgets: times at which the methods are compared, in seconds: from the first scored iteration of any run to the
            last.
        ahead_at: the reference's lead over each other method at each of ``budgets``; a method that has ended by then
            keeps its last score.
        clock: how seconds are measured.
        score: the kind of score.
        only_at_end: whether some run was scored only at its start and end.
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
        """True if intervals are over seeds, so that a difference whose interval excludes 0 exceeds their scatter."""
        return len(self.seeds) > 1

    @property
    def timed(self) -> bool:
        """True if intervals are over seeds and valid at any time, not only at the end of the runs."""
        return self.several and not self.only_at_end

    @property
    def bounds(self) -> list[str]:
        """The detectors of ``BOUNDS`` that the runs have."""
        return [bound for bound in BOUNDS if bound in self.ap]


def compare(
    runs: Sequence[FinishedRun], reference: str, draws: int, seed: int = 0, clock: Clock = "seconds"
) -> Comparison:
    """Compare the runs of one setting.

    Args:
        runs: one run of each method at each seed.
        reference: the method that the others are compared with.
        draws: number of bootstrap draws over test images.
        seed: seed of the bootstrap.
        clock: how seconds are measured.

    Raises:
        ValueError: the reference has no run, or no seed is common to all methods.
    """
    table = score_table(runs, reference, draws, seed)
    methods = methods_of(runs, reference)
    seeds = common_seeds(runs, methods)
    chosen = {(run.method, run.seed): run for run in runs if run.seed in seeds and run.method in methods}
    curves = Curves({key: biased_ap(run, clock) for key, run in chosen.items()}, methods, seeds)
    bounds = [bound for bound in BOUNDS if bound in table.detectors]
    won_back = {method: table.closed(method) for method in methods if "matched" in bounds}
    return Comparison(
        setting=runs[0].setting,
        seeds=seeds,
        methods=methods,
        reference=reference,
        ap={name: table.mean(name) for name in (*bounds, *methods)},
        won_back={method: part for method, part in won_back.items() if not math.isnan(part.value)},
        ahead={method: table.ahead(reference, method) for method in methods[1:]},
        area=curves.area_ahead,
        spent={
            method: {key: _mean(chosen[method, at].spent(key) for at in seeds) for key in (*SPENT, clock)}
            for method in methods
        },
        at_equal_cost=curves.at_equal_cost,
        equal_cost=_mean(curves.cheapest.values()),
        budgets=curves.budgets,
        ahead_at=curves.ahead_at,
        clock=clock,
        score=runs[0].score,
        only_at_end=any((seconds > 0.0).sum() == 1 for seconds, _ in curves.of.values()),
    )


Curve = tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]
"""Seconds spent, and the mean score of the biased objects, at every iteration that was scored."""


def biased_ap(run: FinishedRun, clock: Clock) -> Curve:
    """Return the curve over time of the mean score of the biased objects that the test images show."""
    curve, biased = run.results["curve"], run.results["biased"]
    ap = [mean_over(point["ap"], biased) for point in curve]
    return np.asarray([point[clock] for point in curve]), np.asarray(ap)


def area_under(
    seconds: Float[np.ndarray, "points"], ap: Float[np.ndarray, "points"], first: float, last: float
) -> float:
    """Return the mean of AP over log seconds in [first, last], with AP at every budget given by ``ap_at``."""
    begun = seconds > 0.0
    if not begun.any():
        return float(ap[0])
    lower, upper, points = math.log(first), math.log(last), np.log(seconds[begun])
    start = min(max(points[0], lower), upper)
    edges = np.concatenate([[start], points[(points > start) & (points < upper)], [upper]])
    line = np.trapezoid(np.interp(edges, points, ap[begun]), edges)
    return float(ap[0] * (start - lower) + line) / (upper - lower)


def ap_at(seconds: Float[np.ndarray, "points"], ap: Float[np.ndarray, "points"], budget: float) -> float:
    """Return AP at a budget: linear in log seconds between scored points, the initial AP before the first of them."""
    begun = seconds > 0.0
    if not begun.any() or budget < seconds[begun][0]:
        return float(ap[0])
    return float(np.interp(math.log(budget), np.log(seconds[begun]), ap[begun]))


@dataclass(frozen=True)
class Curves:
    """The curves of all methods at all seeds, read at equal times; the first method is compared with the others."""

    of: Mapping[tuple[str, int], Curve]
    methods: Sequence[str]
    seeds: Sequence[int]

    @property
    def cheapest(self) -> dict[int, float]:
        """The total seconds of the cheapest method, by seed; 0 if no method took any."""
        ends = {at: [self.of[method, at][0][-1] for method in self.methods] for at in self.seeds}
        return {at: min((end for end in own if end > 0.0), default=0.0) for at, own in ends.items()}

    @property
    def at_equal_cost(self) -> dict[str, Estimate]:
        """Every method's score at ``cheapest``."""
        budgets = self.cheapest
        reached = {m: [ap_at(*self.of[m, at], budgets[at]) for at in self.seeds] for m in self.methods}
        return {method: over_seeds(np.asarray(own)).as_fraction for method, own in reached.items()}

    @cached_property
    def budgets(self) -> list[float]:
        """Seconds from the first scored iteration of any run to the last; empty if no run took any."""
        spent = np.concatenate([seconds[seconds > 0.0] for seconds, _ in self.of.values()])
        if not len(spent):
            return []
        return np.unique(np.geomspace(spent.min(), spent.max(), BUDGETS)).tolist()

    @property
    def ahead_at(self) -> dict[str, list[Estimate]]:
        """The first method's lead over each other one at each of ``budgets``; empty without budgets."""
        reached = [{key: ap_at(*curve, budget) for key, curve in self.of.items()} for budget in self.budgets]
        others = self.methods[1:] if reached else ()
        return {method: [self._ahead(values, method) for values in reached] for method in others}

    @property
    def area_ahead(self) -> dict[str, Estimate]:
        """The first method's lead in the area under the curve, from the first scored iteration to the last end."""
        spent = [times[times > 0.0] for times, _ in self.of.values() if (times > 0.0).any()]
        first, last = (
            min((times.min() for times in spent), default=0.0),
            max((t.max() for t in spent), default=0.0),
        )
        if first >= last:
            return {}
        areas = {key: area_under(*curve, first, last) for key, curve in self.of.items()}
        return {method: self._ahead(areas, method) for method in self.methods[1:]}

    def _ahead(self, values: Mapping[tuple[str, int], float], method: str) -> Estimate:
        first = self.methods[0]
        return over_seeds(np.asarray([values[first, at] - values[method, at] for at in self.seeds]))


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


# --- costs ---

PHASES: Mapping[str, tuple[str, ...]] = {
    "first step": ("first_step",),
    "images": ("pool", "probes", "render", "features"),
    "training": ("train",),
    "derivative": ("hypergradient",),
    "scores": ("judge", "reward", "certify"),
}
"""The phases in records of the psi loop that make up each column of the table."""
SECONDS = ("warm start", *PHASES, "in all")
HEAD = (*(f"{column}, s" for column in SECONDS), "MB", "images", "error of the gradient")
"""Headings of the columns of ``cells``."""
NOTE = (
    "Wall-clock seconds of the warm start and of each phase of the psi loop; the first step is the reading of the "
    "target's boxes. MB: peak memory of a run's process. Images: those rendered for the warm start and the loop. Error "
    "of the gradient: its standard error over images relative to its length, median over iterations and objects."
)


@dataclass(frozen=True)
class Costs:
    """The costs of one method.

    Args:
        seconds: seconds by column of ``SECONDS``, means over runs.
        images: number of rendered images, mean over runs.
        memory: peak memory of any run in MB; None: not recorded.
        error: median standard error of a gradient relative to its length; None: there is no gradient, or its error is
            not known.
    """

    seconds: Mapping[str, float]
    images: float
    memory: float | None
    error: float | None


def costs(runs: Sequence[FinishedRun]) -> dict[str, Costs]:
    """Return the costs of every method, in the order of the runs."""
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for run in runs:
        by_method.setdefault(run.method, []).append(run.results)
    return {method: _costs(results) for method, results in by_method.items()}


def _costs(runs: Sequence[Mapping[str, Any]]) -> Costs:
    spent = [_seconds(run) for run in runs]
    memory = [run["peak_memory_mb"] for run in runs if "peak_memory_mb" in run]
    errors = [error for run in runs for error in _errors(run["iterations"])]
    return Costs(
        {column: fmean(each[column] for each in spent) for column in SECONDS},
        fmean(run["curve"][-1]["images"] for run in runs),
        max(memory, default=None),
        median(errors) if errors else None,
    )


def _seconds(run: Mapping[str, Any]) -> dict[str, float]:
    """Return seconds by column of ``SECONDS``; phases ``hypergradient_*`` are parts of ``hypergradient``."""
    loop = {
        column: sum(record["seconds"].get(phase, 0.0) for record in run["iterations"] for phase in phases)
        for column, phases in PHASES.items()
    }
    total = run["curve"][-1]["seconds"]
    # A result from the store is charged with the seconds that it took to make, not with those of this run's stage.
    before = max(total - sum(loop.values()), 0.0)
    if run.get("shown") and not run["iterations"]:
        # The method is a reading of the target's boxes, and trains no detector.
        before, loop["first step"] = 0.0, before
    return {"warm start": before, **loop, "in all": total}


def _errors(records: Iterable[Mapping[str, Any]]) -> list[float]:
    """Return the relative error of every object's gradient in every iteration.

    Gradients that are zero or whose error is unknown are left out, as are those of older runs, which did not record it.
    """
    pairs = [
        pair
        for record in records
        if "gradient_errors" in record
        for pair in zip(record["gradient_errors"], record["gradient_norms"], strict=True)
    ]
    known = [pair for pair in pairs if None not in pair]  # JSON has null for what is not finite
    return [
        error / norm for error, norm in known if norm > 0.0 and error > 0.0 and math.isfinite(error / norm)
    ]


def costs_table(runs: Sequence[FinishedRun]) -> str:
    """Return a Markdown table with one row per method, which says how many runs it has if these numbers differ."""
    number = Counter(run.method for run in runs)
    unequal = len({*number.values()}) > 1
    rows = [
        [f"{method}, mean of {number[method]}" if unequal else method, *cells(cost)]
        for method, cost in costs(runs).items()
    ]
    commits = sorted({run.results.get("commit") or UNKNOWN for run in runs})
    note = " Methods have different numbers of runs, which may be of different settings." if unequal else ""
    made = f"{len(runs)} run{'s' * (len(runs) > 1)}, commit{'s' * (len(commits) > 1)} {', '.join(commits)}"
    return f"{markdown_table(['cost', *HEAD], rows)}\n\n{made}.{note} {NOTE}"


def cells(cost: Costs) -> list[str]:
    """Return a row's numbers as text, under ``HEAD``."""
    seconds = [f"{cost.seconds[column]:.0f}" for column in SECONDS]
    memory = "" if cost.memory is None else f"{cost.memory:.0f}"
    return [*seconds, memory, f"{cost.images:.0f}", "" if cost.error is None else f"{cost.error:.2f}"]
