"""Error of whole methods against their run time, for this run's own method and finished runs in MLflow."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from neural_sim.report import tracking
from neural_sim.report.runs import Runs, select
from neural_sim.studies.work_precision.measurement import Clock, Point, Series, Timing, World

Results = Mapping[str, Any]
COMMAND = "python -m src.main -m +experiment={experiment} baseline=neural_sim,auto_sim,lts seed=0,1"


@dataclass(frozen=True)
class Loops:
    """The family ``loop``.

    Args:
        experiment: MLflow experiment of the finished runs.
        reference: the default method, whose runs the others must be comparable with.
    """

    experiment: str = "pose_gap"
    reference: str = "neural_sim"

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure this run's own method, and read every group of comparable finished runs."""
        del seed
        groups = []
        if self.experiment in tracking.experiments(world.uri):
            groups, _ = select(Runs.read(world.uri, [self.experiment]), self.reference)
        command = COMMAND.format(experiment=self.experiment)
        missing = (
            "" if groups else f" MLflow has no finished run of {self.experiment} yet: `{command}` makes some."
        )
        yield from series("this run", [world.results], self.reference, timing.clock, missing)
        for group in groups:
            runs = [run.results for run in group.runs]
            yield from series(group.label, runs, self.reference, timing.clock)


def series(
    label: str, runs: Sequence[Results], reference: str, clock: Clock, more: str = ""
) -> Iterator[Series]:
    """Yield AP of the biased classes, validation loss by objective and distance to the target, means over seeds."""
    methods = {run["method"]: [r for r in runs if r["method"] == run["method"]] for run in runs}
    seeds = sorted({run["seed"] for run in runs})
    note = f"{', '.join(runs[0]['biased'])}; seeds {', '.join(map(str, seeds))}; the warm start is included.{more}"
    scored, distances = [], []
    losses: dict[
        str, list[Point]
    ] = {}  # by objective, since losses of different objectives are not comparable
    for method, mine in methods.items():
        for place in range(min(len(run["curve"]) for run in mine)):
            points = [(run["curve"][place], run) for run in mine]
            last, setting = (
                place == len(mine[0]["curve"]) - 1,
                f"{method}, {points[0][0]['iteration']} iterations",
            )
            error = 1.0 - fmean(biased_ap(point, run) for point, run in points)
            spent = fmean(point[clock] for point, _ in points)
            if spent <= 0.0:  # the start, before any work
                continue
            scored.append(
                Point(
                    setting,
                    error,
                    spent,
                    None,
                    last and method == reference,
                    method,
                    half(mine, clock) if last else "",
                )
            )
        ends, default = fmean(run["curve"][-1][clock] for run in mine), method == reference
        if all(run["iterations"] for run in mine):
            loss = fmean(run["iterations"][-1]["validation_loss"] for run in mine)
            point = Point(method, loss, ends, None, default, method)
            losses.setdefault(objective_of(mine[0]), []).append(point)
        distances.append(Point(method, fmean(distance(run) for run in mine), ends, None, default, method))
    kinds = (
        ("AP", "1 - AP of the biased classes", scored),
        *((f"objective {name}", "validation loss", points) for name, points in losses.items()),
        ("distance", "total variation to the target", distances),
    )  # fmt: skip
    for kind, error, points in kinds:
        if points:
            yield Series(f"loop/{label}, {kind}", error, tuple(points), (), note, clock)


def biased_ap(point: Mapping[str, Any], run: Results) -> float:
    """Return the mean AP of the biased classes at a point of a run's curve, ignoring classes not in the test set."""
    known = [point["ap"]["per_class"].get(name) for name in run["biased"]]
    return fmean(value for value in known if value is not None)


def distance(run: Results) -> float:
    """Return the total variation between learned and target distribution, mean over biased objects and factors."""
    away = run["total_variation"]
    return fmean(factor["learned"] for name in run["biased"] for factor in away[name].values())


def seconds_to_half(run: Results, clock: Clock) -> float:
    """Return seconds until the first scored point that closes half of the gap from ns to matched, or infinity."""
    ns, matched = (biased_ap({"ap": run["ap"][which]}, run) for which in ("ns", "matched"))
    wanted = 0.5 * (ns + matched)
    reached = [point[clock] for point in run["curve"] if biased_ap(point, run) >= wanted]
    return min(reached) if reached and matched > ns else math.inf


def half(runs: Sequence[Results], clock: Clock) -> str:
    """Say when half of the gap was closed: mean over the seeds that closed it, and their number."""
    reached = [spent for run in runs if math.isfinite(spent := seconds_to_half(run, clock))]
    if not reached:
        return f"half the gap: never in {len(runs)}"
    return f"half the gap: {fmean(reached):.3g} s, in {len(reached)} of {len(runs)}"


def objective_of(run: Results) -> str:
    """Return the name of a run's outer objective; older runs stored a word instead of a class."""
    objective = run["config"]["outer"]["objective"]
    return objective if isinstance(objective, str) else objective["_target_"].rpartition(".")[2]
