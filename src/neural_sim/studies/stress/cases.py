"""What a case of the stress suite is given, and what it yields."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

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
        """Return a new generator, the same for every call."""
        return torch.Generator().manual_seed(self.seed)

    def normal(self, *shape: int) -> Tensor:
        """Draw standard normal numbers in float64, the same for every call."""
        return torch.randn(*shape, generator=self.generator(), dtype=DOUBLE)


@dataclass(frozen=True)
class Check:
    """One number compared with its bound: passes where ``value <= tolerance`` and the status is a wanted one.

    ``value`` is an error (0 is perfect), ``tolerance`` what theory allows it, ``wanted`` the statuses that are right
    here (empty: the quantity has none). NaN never passes. The suite adds the case and the ``seconds`` that led to the
    value.
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
        """Whether value and status are right."""
        return self.value <= self.tolerance and (not self.wanted or self.status in self.wanted)

    @property
    def used(self) -> float:
        """Part of the tolerance that the value uses up; above 1 the check has failed."""
        if self.value == 0.0:
            return 0.0
        return self.value / self.tolerance if self.tolerance > 0.0 else math.inf

    def record(self) -> dict[str, Any]:
        """Return the check as JSON; a number that does not exist is null."""
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


def eps(dtype: torch.dtype) -> float:
    """Return the spacing of the numbers above 1; the unit roundoff is half of it."""
    return torch.finfo(dtype).eps


def worst(*tensors: Tensor) -> float:
    """Return the largest size of any entry; NaN where there is one."""
    return max((float(tensor.detach().abs().max()) for tensor in tensors), key=lambda v: (math.isnan(v), v))


def not_finite(*tensors: Tensor) -> float:
    """Count the entries that are NaN or infinite."""
    return float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


def short(dtype: torch.dtype) -> str:
    """Return a type's name without its module."""
    return str(dtype).removeprefix("torch.")
