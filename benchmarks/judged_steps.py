"""What the steps of finished psi loops were expected to gain, what the training that judged them measured, and what an
independent training says.

`python benchmarks/judged_steps.py FOLDER ...` reads every results.json below the folders and prints a table. The
derivative of iteration k is taken in a training at the psi that the step before it led to, with other random numbers
than the training that judged the step. The difference of an object's score to iteration k - 1 is the last column. A
step is accepted more readily where the training of iteration k - 1 happened to score low, so that this difference is
somewhat too high for accepted steps, and too low for rejected ones, after which the object is where it was.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any


@dataclass(frozen=True)
class Judged:
    """One object's step; gains are of its smooth AP (``outer.objective``)."""

    biased: bool
    first: bool
    accepted: bool
    expected: float
    measured: float
    independent: float


def judged(results: dict[str, Any]) -> Iterator[Judged]:
    """The steps of one run, the last one apart, after which nothing is trained."""
    names, iterations = list(results["psi"]), results["iterations"]
    for k in range(1, len(iterations) - 1):
        before, after = iterations[k - 1]["scores"], iterations[k]["scores"]
        for name, verdict in iterations[k]["verdicts"].items():
            label = names.index(name)
            yield Judged(
                biased=name in results["biased"], first=k == 1, accepted=verdict["accepted"],
                expected=verdict["expected_gain"], measured=verdict["measured_gain"],
                independent=after[label] - before[label],
            )  # fmt: skip


GROUPS: dict[str, Callable[[Judged], bool]] = {
    "first, accepted": lambda step: step.first and step.accepted,
    "later, accepted": lambda step: not step.first and step.accepted,
    "of these, of biased objects": lambda step: not step.first and step.accepted and step.biased,
    "of these, of the others": lambda step: not step.first and step.accepted and not step.biased,
    "rejected": lambda step: not step.accepted,
}


def with_error(values: list[float]) -> str:
    error = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return f"{fmean(values):.4f} ({error:.4f})"


def table(steps: list[Judged]) -> str:
    """Means and, in brackets, standard errors; groups without a step are left out."""
    lines = [
        "| steps | number | expected | judging training | independent training |",
        "|---|---|---|---|---|",
    ]
    for name, belongs in GROUPS.items():
        if rows := [step for step in steps if belongs(step)]:
            gains = zip(*((row.expected, row.measured, row.independent) for row in rows), strict=True)
            lines.append(f"| {name} | {len(rows)} | " + " | ".join(with_error(list(g)) for g in gains) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="runs, or folders of runs")
    parser.add_argument("--commit", help="runs of this commit alone (its first letters)")
    arguments = parser.parse_args()
    found = sorted({file for folder in arguments.folders for file in folder.rglob("results.json")})
    runs = [json.loads(file.read_text()) for file in found]
    kept = [
        run
        for run in runs
        if run.get("method") == "neural_sim"
        and (not arguments.commit or str(run["commit"]).startswith(arguments.commit))
        and any(iteration.get("verdicts") for iteration in run["iterations"])
    ]
    if not kept:
        raise SystemExit(
            f"judged_steps: {len(found)} results.json, none of a loop (method neural_sim) with checked steps"
        )
    print(
        f"{len(kept)} run{'s' * (len(kept) > 1)}\n\n" + table([step for run in kept for step in judged(run)])
    )


if __name__ == "__main__":
    main()
