"""The result of a linear solve: a value, and how far to trust it."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


class Status(enum.Enum):
    """How a solve ended; the value says what to change."""

    CONVERGED = "residual below tolerance"
    APPROXIMATE = "a fixed approximation, not iterated to a tolerance: read the residual"
    MAX_STEPS = "step budget spent: raise max_steps or damping"
    STAGNATED = "residual stopped falling: the limit of this arithmetic, raise damping or precision"
    NEGATIVE_CURVATURE = "operator is not positive definite: raise damping"
    LEAST_SQUARES = "singular and inconsistent: the value minimises the residual, which cannot vanish"
    SINGULAR = "operator is singular to rounding: the value is the minimum-norm solution on its range"
    UNROLLED = "no system was solved: the derivative is that of the training that was run"
    MEASURED = "no system was solved: trainings were compared"
    NON_FINITE = "operator, right-hand side or solution is not finite"


@dataclass(frozen=True)
class Solution:
    """Result of ``A x = b``. Every field is finite whatever the inputs were.

    ``residual`` is ``|b - A x| / |b|`` recomputed from a fresh product, never the recursion's, hence
    unchanged when A and b are rescaled; 0 for b = 0, and 1 where no value is finite and ``value`` is
    zero. Only an APPROXIMATE value may have a residual above 1. ``curvature`` is the smallest and largest
    Rayleigh quotient ``p^T A p / p^T p`` of all products taken (0, 0 if none). ``products`` counts all
    applications of A, ``steps`` the solver's own iterations. ``warm_started`` says whether x0 was used (it is
    dropped when its residual is no better than that of zero).
    """

    value: Float[Tensor, "n"]
    status: Status
    steps: int
    residual: float
    curvature: tuple[float, float]
    products: int
    warm_started: bool
