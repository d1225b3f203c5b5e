"""Inputs and outputs of the cases of the stress suite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

FALSE_ALARM = 1e-9
"""Largest probability with which a statistical check fails although the code is right."""
DOUBLE, SINGLE = torch.float64, torch.float32


@dataclass(frozen=True)
class Scope:
    """Input of every case: the seed of its random problems, and whether heavy ones run at full size.

    Tolerances are valid for every seed; each statistical check fails with probability below ``FALSE_ALARM``.
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
    """One number compared with its bound: passes if ``value <= tolerance`` and the status is a wanted one.

    ``value`` is an error (0 is perfect), ``tolerance`` the error that theory allows, ``wanted`` the correct statuses
    (empty: the quantity has none). NaN never passes. The suite adds the case and the ``seconds`` it took.
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
        """Fraction of the tolerance that the value uses up; above 1 the check has failed."""
        if self.value == 0.0:
            return 0.0
        return self.value / self.tolerance if self.tolerance > 0.0 else math.inf

    def record(self) -> dict[str, Any]:
        """Return the check as JSON; undefined numbers are null."""
        values = {key: value for key, value in asdict(self).items() if key != "wanted"}
        numbers = {key: None for key in ("value", "tolerance") if not math.isfinite(values[key])}
        return {**values, **numbers, "passed": self.passed}


Checks = Iterator[Check]
CASES: dict[str, Callable[[Scope], Checks]] = {}
"""Every case by ``family/name``, in the order of definition."""


def case(function: Callable[[Scope], Checks]) -> Callable[[Scope], Checks]:
    """Register a case under the names of its file and its function."""
    CASES[f"{function.__module__.rsplit('.', 1)[-1]}/{function.__name__}"] = function
    return function


def eps(dtype: torch.dtype) -> float:
    """Return the spacing of the numbers above 1; the unit roundoff is half of it."""
    return torch.finfo(dtype).eps


def worst(*tensors: Tensor) -> float:
    """Return the largest absolute value of any entry; NaN if there is a NaN."""
    return max((float(tensor.detach().abs().max()) for tensor in tensors), key=lambda v: (math.isnan(v), v))


def not_finite(*tensors: Tensor) -> float:
    """Count the entries that are NaN or infinite."""
    return float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


def short(dtype: torch.dtype) -> str:
    """Return the name of a type without its module."""
    return str(dtype).removeprefix("torch.")
