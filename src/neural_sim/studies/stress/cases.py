"""What a stress case is, what it yields, and the suite that runs families of cases one after another."""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

FAMILIES = ("linear", "inner", "estimators", "sampling", "simplex", "rendering", "imaging", "outer")
"""One file each, in the order of the loop: its cases are the functions marked ``@case``."""
FALSE_ALARM = 1e-9
"""Probability with which a statistical check may fail where the code is right."""
DOUBLE, SINGLE = torch.float64, torch.float32


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

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers in float64, the same for every call."""
        return torch.randn(*shape, generator=self.generator(), dtype=DOUBLE)


@dataclass(frozen=True)
class Check:
    """One number compared with its bound: passes where ``value <= tolerance`` and the status is a wanted one.

    ``value`` is an error (0 is perfect), ``tolerance`` what theory allows it, ``wanted`` the statuses that
    are right here (empty: the quantity has none). NaN never passes. The suite adds the case and the ``seconds`` that
    led to the value.
    """

    quantity: str
    value: float
    tolerance: float
    status: str = ""
    wanted: tuple[str, ...] = ()
    case: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return self.value <= self.tolerance and (not self.wanted or self.status in self.wanted)

    @property
    def used(self) -> float:
        """Part of the tolerance that the value uses up; above 1 the check has failed."""
        if self.value == 0.0:
            return 0.0
        return self.value / self.tolerance if self.tolerance > 0.0 else math.inf

    def record(self) -> dict[str, Any]:
        """As JSON; a number that does not exist is null."""
        values = {key: value for key, value in asdict(self).items() if key != "wanted"}
        numbers = {key: None for key in ("value", "tolerance") if not math.isfinite(values[key])}
        return {**values, **numbers, "passed": self.passed}


Checks = Iterator[Check]
CASES: dict[str, Callable[[Scope], Checks]] = {}
"""Every case by ``family/name``, in the order of definition."""


def case(function: Callable[[Scope], Checks]) -> Callable[[Scope], Checks]:
    """Register a case under the name of its file and its own."""
    CASES[f"{function.__module__.rsplit('.', 1)[-1]}/{function.__name__}"] = function
    return function


def run_case(name: str, scope: Scope) -> Checks:
    """A case's checks as they come. One that raises, or checks nothing, has failed; the next ones still run."""
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


@dataclass(frozen=True)
class Suite:
    """Runs every case of ``families``; ``full`` False takes smaller versions of the heavy ones.

    Raises:
        ValueError: an unknown family, or none.
    """

    families: Sequence[str] = FAMILIES
    full: bool = True

    def __post_init__(self) -> None:
        if not self.families or not set(self.families) <= set(FAMILIES):
            raise ValueError(
                f"stress.families wants some of {', '.join(FAMILIES)}, got {list(self.families)}"
            )

    def run_all(self, seed: int, progress: bool = False) -> list[Check]:
        """All checks; a case that fails or raises does not keep the others from running."""
        for family in self.families:
            importlib.import_module(f"{__package__}.{family}")
        names = [name for family in self.families for name in CASES if name.split("/")[0] == family]
        shown = tqdm(names, desc="stress", disable=not progress, leave=False)
        with _quiet():
            return [check for name in shown for check in run_case(name, Scope(seed, self.full))]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings in the log: the cases provoke them, and statuses are what they check."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def eps(dtype: torch.dtype) -> float:
    """Spacing of the numbers above 1; the unit roundoff is half of it."""
    return torch.finfo(dtype).eps


def worst(*tensors: Tensor) -> float:
    """The largest size of any entry; NaN where there is one."""
    return max((float(tensor.detach().abs().max()) for tensor in tensors), key=lambda v: (math.isnan(v), v))


def not_finite(*tensors: Tensor) -> float:
    """How many entries are NaN or infinite."""
    return float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


def short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
