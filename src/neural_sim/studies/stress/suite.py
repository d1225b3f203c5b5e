"""``+experiment=stress``: run stiff and extreme cases, family by family, and report what fails."""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

from annotated_types import MinLen
from tqdm import tqdm

from neural_sim.documents import markdown_table, write_whole
from neural_sim.ranges import Distinct, validated
from neural_sim.studies.stress.cases import CASES, Check, Checks, Scope
from neural_sim.tasks.context import Context, Task, TaskFailure

Family = Literal["linear", "inner", "estimators", "sampling", "rendering", "outer"]
FAMILIES: tuple[Family, ...] = get_args(Family)
"""Families, one file each; their cases are the functions marked ``@case``."""


@validated
@dataclass(frozen=True)
class Stress(Task):
    """Run every case of some families.

    Args:
        families: families to run, in this order.
        full: whether heavy cases run at full size.
    """

    families: Annotated[Sequence[Family], MinLen(1), Distinct()] = FAMILIES
    full: bool = True

    def run(self, context: Context) -> None:
        """Run and publish every check.

        Raises:
            TaskFailure: a check failed; raised after everything has been written.
        """
        checks = self.run_all(context.config["seed"], context.config["progress"])
        write_whole(context.folder / "stress.md", markdown(checks))
        print(table(checks))
        context.publish("stress", [check.record() for check in checks], metrics=metrics(checks))
        failed = failures(checks)
        if failed:
            raise TaskFailure(f"stress: {len(failed)} checks failed")

    def run_all(self, seed: int, progress: bool = False) -> list[Check]:
        """Run all checks; a case that fails or raises does not stop the others."""
        for family in self.families:
            importlib.import_module(f"{__package__}.{family}")
        names = [name for family in self.families for name in CASES if name.split("/")[0] == family]
        shown = tqdm(names, desc="stress", disable=not progress, leave=False)
        with _quiet():
            return [check for name in shown for check in run_case(name, Scope(seed, self.full))]


def run_case(name: str, scope: Scope) -> Checks:
    """Yield the checks of a case as they come; one that raises or checks nothing has failed."""
    checks, count = CASES[name](scope), 0
    while True:
        begin, ended = time.perf_counter(), True
        try:
            check = next(checks, None)
            ended = check is None
        except Exception as error:  # whatever a case raises is its result
            check = Check("runs to its end", math.nan, 0.0, f"{type(error).__name__}: {error}".split("\n")[0])
        if check is None and count == 0:
            check = Check("checks something", math.nan, 0.0, "no check")
        if check is not None:
            yield replace(check, case=name, seconds=time.perf_counter() - begin)
        if ended:
            return
        count += 1


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep warnings out of the log; cases provoke them, and check statuses instead."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def failures(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that failed."""
    return [check for check in checks if not check.passed]


def _by_case(checks: Sequence[Check]) -> dict[str, list[Check]]:
    cases: dict[str, list[Check]] = {}
    for check in checks:
        cases.setdefault(check.case, []).append(check)
    return cases


def metrics(checks: Sequence[Check]) -> dict[str, float]:
    """Return MLflow metrics: counts, and each case's failures, largest fraction of a tolerance used, and seconds."""
    found = {"checks": float(len(checks)), "failed": float(len(failures(checks)))}
    for name, own in _by_case(checks).items():
        found |= {
            f"{name}/failed": float(len(failures(own))),
            f"{name}/used": max(check.used for check in own),
            f"{name}/seconds": sum(check.seconds for check in own),
        }
    return found


def table(checks: Sequence[Check]) -> str:
    """Return a line per case (checks, failures, largest fraction of a tolerance used, seconds), then the failures."""
    lines = [f"{'case':<38}{'checks':>7}{'failed':>7}{'used':>9}{'seconds':>9}"]
    for name, own in _by_case(checks).items():
        used = max(check.used for check in own)
        spent = sum(check.seconds for check in own)
        lines.append(f"{name:<38}{len(own):>7}{len(failures(own)):>7}{used:>9.1g}{spent:>9.2f}")
    wrong = failures(checks)
    lines += [
        f"FAILED {c.case}: {c.quantity}: {c.value:.3g}, tolerance {c.tolerance:.3g} {c.status}" for c in wrong
    ]
    spent = sum(check.seconds for check in checks)
    lines.append(f"{len(checks)} checks in {len(_by_case(checks))} cases, {len(wrong)} failed, {spent:.1f} s")
    return "\n".join(lines)


def markdown(checks: Sequence[Check]) -> str:
    """Return every check as a table, case by case."""
    parts = ["# Stress suite", f"{len(checks)} checks, {len(failures(checks))} failed."]
    head = ["quantity", "value", "tolerance", "status", "", "seconds"]
    for name, own in _by_case(checks).items():
        rows = [
            (
                check.quantity,
                f"{check.value:.3g}",
                f"{check.tolerance:.3g}",
                check.status,
                "passed" if check.passed else "**failed**",
                f"{check.seconds:.3f}",
            )
            for check in own
        ]
        parts += [f"## {name}", markdown_table(head, rows)]
    return "\n\n".join(parts) + "\n"
