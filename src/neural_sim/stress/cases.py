"""What a stress case is, what it yields, and how all of them are run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Scope:
    """What every case is given: the seed of its random problems, and whether heavy ones run at full size.

    Tolerances hold for every seed; statistical ones fail with probability below ``FALSE_ALARM`` each.
    """

    seed: int = 0
    full: bool = True

    def generator(self) -> torch.Generator:
        """A new generator, the same for every call."""
        return torch.Generator().manual_seed(self.seed)


FALSE_ALARM = 1e-9
"""Probability with which a statistical check may fail where the code is right."""


@dataclass(frozen=True)
class Check:
    """One number held against its bound: passes where ``value <= tolerance`` and the status is a wanted one.

    ``value`` is an error (0 is perfect), ``tolerance`` what theory allows it, ``wanted`` the statuses that
    are right here (empty: the quantity has none). NaN never passes.
    """

    quantity: str
    value: float
    tolerance: float
    status: str = ""
    wanted: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return self.value <= self.tolerance and (not self.wanted or self.status in self.wanted)


@dataclass(frozen=True)
class Result:
    """A check's outcome as ``stress.json`` holds it; ``seconds`` includes the work that led to the value."""

    case: str
    quantity: str
    value: float
    tolerance: float
    status: str
    passed: bool
    seconds: float

    @property
    def used(self) -> float:
        """Part of the tolerance that the value uses up; above 1 the check has failed."""
        if self.value == 0.0:
            return 0.0
        return self.value / self.tolerance if self.tolerance > 0.0 else math.inf

    def record(self) -> dict[str, Any]:
        """As JSON; a number that does not exist is null."""
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in asdict(self).items()
        }


Checks = Iterator[Check]
CASES: dict[str, Callable[[Scope], Checks]] = {}
"""Every case by ``family/name``, in the order of definition."""


def case(function: Callable[[Scope], Checks]) -> Callable[[Scope], Checks]:
    """Register a case under the name of its file and its own."""
    CASES[f"{function.__module__.rsplit('.', 1)[-1]}/{function.__name__}"] = function
    return function


def run_case(name: str, scope: Scope) -> Iterator[Result]:
    """A case's results as they come. One that raises, or checks nothing, has failed; the next ones still run."""
    checks, count = CASES[name](scope), 0
    while True:
        begin = time.perf_counter()
        try:
            check = next(checks, None)
        except Exception as error:  # whatever a case raises is its result
            status = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            yield Result(name, "runs to its end", math.nan, 0.0, status, False, time.perf_counter() - begin)
            return
        seconds = time.perf_counter() - begin
        if check is None:
            if count == 0:
                yield Result(name, "checks something", math.nan, 0.0, "no check", False, seconds)
            return
        count += 1
        yield Result(
            name,
            check.quantity,
            float(check.value),
            float(check.tolerance),
            check.status,
            check.passed,
            seconds,
        )


def eps(dtype: torch.dtype) -> float:
    """Spacing of the numbers above 1; the unit roundoff is half of it."""
    return torch.finfo(dtype).eps
