"""The costs of methods: seconds by phase, images, memory, and the relative error of their gradients."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

from neural_sim.documents import markdown_table
from neural_sim.report.runs import FinishedRun
from neural_sim.report.tracking import UNKNOWN

PHASES: Mapping[str, tuple[str, ...]] = {
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
    "Seconds on the wall, of the warm start and of the psi loop by phase. MB: the most that the process of a run had "
    "in memory. Images: those rendered for both. Error of the gradient: its standard error over images relative to "
    "its length, median over iterations and objects."
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
    return {"warm start": max(total - sum(loop.values()), 0.0), **loop, "in all": total}


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
    return [
        error / norm for error, norm in pairs if norm > 0.0 and error > 0.0 and math.isfinite(error / norm)
    ]


def costs_table(runs: Sequence[FinishedRun]) -> str:
    """Return a Markdown table with one row per method."""
    table = markdown_table(["cost", *HEAD], [[method, *cells(cost)] for method, cost in costs(runs).items()])
    commits = sorted({run.results.get("commit") or UNKNOWN for run in runs})
    return f"{table}\n\nOf {len(runs)} run{'s' * (len(runs) > 1)}, commit {', '.join(commits)}. {NOTE}"


def cells(cost: Costs) -> list[str]:
    """Return a row's numbers as text, under ``HEAD``."""
    seconds = [f"{cost.seconds[column]:.0f}" for column in SECONDS]
    memory = "" if cost.memory is None else f"{cost.memory:.0f}"
    return [*seconds, memory, f"{cost.images:.0f}", "" if cost.error is None else f"{cost.error:.2f}"]
