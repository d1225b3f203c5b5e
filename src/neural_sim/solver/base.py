"""Base class of all solvers: scaling, warm start, recomputed residual, and a result that says how far to trust it."""

from __future__ import annotations

import abc
import enum
import logging
import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from annotated_types import Gt, Lt
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.operator import Matvec, NonFiniteProduct, Watched, norm

RestartGain = Annotated[float, Gt(0), Lt(1)]
"""The largest fraction of the residual that a restart may leave."""

logger = logging.getLogger(__name__)


class Status(enum.Enum):
    """How a solve ended; the value explains it and, where something can be done, says what."""

    CONVERGED = "residual below tolerance"
    APPROXIMATE = "a fixed approximation, not iterated to a tolerance: read the residual"
    MAX_STEPS = "step budget spent: raise max_steps or damping"
    STAGNATED = "residual stopped falling: the limit of this arithmetic, raise damping or precision"
    NEGATIVE_CURVATURE = "operator is not positive definite: raise damping"
    LEAST_SQUARES = "singular and inconsistent: the value minimises the residual, which cannot vanish"
    SINGULAR = "operator is singular up to rounding: the value is the minimum-norm solution on its range"
    NON_FINITE = "operator, right-hand side or solution is not finite"


@dataclass(frozen=True)
class Solution:
    """Result of ``A x = b``; every field is finite whatever the inputs were.

    ``residual`` is ``|b - A x| / |b|``, computed from a fresh product, never taken from the recurrence. Rescaling A or
    b does not change it. It is 0 for b = 0, and 1 if nothing finite was found, in which case ``value`` is zero. Only an
    APPROXIMATE value may have a residual above 1. ``curvature`` is the smallest and largest Rayleigh quotient
    ``p^T A p / p^T p`` of all products (0, 0 if none). ``products`` counts all applications of A, ``steps`` the
    solver's own iterations. ``warm_started`` says whether the solver began at x0 (which is dropped unless its residual
    is below that of zero).
    """

    value: Float[Tensor, "n"]
    status: Status
    steps: int
    residual: float
    curvature: tuple[float, float]
    products: int
    warm_started: bool


@dataclass(frozen=True)
class Iterate:
    """Where an iteration stopped; CONVERGED here is a claim that ``LinearSolver.solve`` checks.

    ``residual`` is the norm of ``rhs - A value`` from a fresh product, or None if the iteration did not end with one.
    """

    value: Float[Tensor, "n"]
    status: Status
    steps: int
    residual: float | None = None


@dataclass(frozen=True)
class Search:
    """State of a conjugate-gradient search, from which the search can continue.

    ``residual`` is ``b - A value`` by the recurrence, ``direction`` the next search direction, which only conjugate
    gradients use.
    """

    value: Float[Tensor, "n"]
    residual: Float[Tensor, "n"]
    direction: Float[Tensor, "n"]

    def divided(self, scale: float) -> Search:
        """Return the state of the search for a right-hand side divided by ``scale``."""
        return Search(self.value / scale, self.residual / scale, self.direction / scale)


@dataclass(frozen=True)
class System:
    """``operator x = rhs`` as passed to a solver's iteration: ``rhs`` has norm in [1, 2), ``tolerance`` is absolute.

    ``residual`` is the residual at ``start``. If it meets the tolerance, it comes from a fresh product. Otherwise it
    may come from a search's recurrence; ``direction`` is then the search's next direction.
    """

    operator: Watched
    rhs: Float[Tensor, "n"]
    start: Float[Tensor, "n"]
    residual: Float[Tensor, "n"]
    direction: Float[Tensor, "n"] | None
    tolerance: float
    max_steps: int


@dataclass(frozen=True)
class LinearSolver(abc.ABC):
    """Solves ``A x = b`` for symmetric A, given by its products. Subclasses hold typed hyper-parameters.

    ``iterative`` is False for solvers whose result does not depend on where they start.
    """

    iterative: ClassVar[bool] = True

    @property
    def largest(self) -> int | None:
        """Largest number of unknowns that the solver accepts; None: no limit."""
        return None

    @abc.abstractmethod
    def iterate(self, system: System) -> Iterate:
        """Iterate until the residual's norm is at most the system's tolerance or its steps are spent."""

    def solve(
        self,
        matvec: Matvec,
        b: Float[Tensor, "n"],
        x0: Float[Tensor, "n"] | Search | None = None,
        rtol: float = 1e-3,
        max_steps: int = 40,
    ) -> Solution:
        """Solve to ``|b - A x| <= rtol |b|`` in at most ``max_steps`` steps.

        Args:
            matvec: products with A.
            b: the right-hand side.
            x0: where to start: a vector, or a search to continue; None: zero. Ignored by solvers that do not iterate.
            rtol: relative residual at which to stop.
            max_steps: step limit; the cost of a step depends on the solver.

        Returns:
            The solution and its status. Non-finite input gives a status, never a NaN.

        Raises:
            ValueError: inconsistent shapes or invalid settings.
        """
        _check(b, x0.value if isinstance(x0, Search) else x0, rtol, max_steps)
        operator = Watched(matvec)
        scale = float(b.abs().max())
        if scale == 0.0:
            return Solution(torch.zeros_like(b), Status.CONVERGED, 0, 0.0, (0.0, 0.0), 0, False)
        failed = Solution(torch.zeros_like(b), Status.NON_FINITE, 0, 1.0, (0.0, 0.0), 0, False)
        if not bool(torch.isfinite(b).all()):
            return failed
        scale = _power_of_two(scale)
        rhs = b / scale  # so that products stay within the range of float32, whatever the unit of b
        unit = _power_of_two(norm(rhs))
        rhs = rhs / unit
        size = norm(rhs)
        try:
            guess = _scaled(x0, scale, unit) if self.iterative else None
            system = _started(operator, rhs, guess, rtol * size, max_steps)
            end = self.iterate(system)
            reached = norm(rhs - operator(end.value)) if end.residual is None else end.residual
            residual = reached / size
        except NonFiniteProduct as error:
            logger.warning("%s: %s", type(self).__name__, error)
            return Solution(
                failed.value, Status.NON_FINITE, 0, 1.0, operator.curvature, operator.products, False
            )
        if residual > 1.0 and end.status is not Status.APPROXIMATE:
            # Rounding made the recursion diverge from the true residual: zero is the better answer.
            logger.warning("%s: the true residual is %.3g; zero is returned", type(self).__name__, residual)
            end, residual = Iterate(torch.zeros_like(rhs), _lost(end.status), end.steps), 1.0
        value = end.value * unit * scale
        if not bool(torch.isfinite(value).all()):
            return Solution(
                failed.value, Status.NON_FINITE, end.steps, 1.0, operator.curvature, operator.products, False
            )
        status = _verified(end.status, residual, rtol)
        warm = bool(system.start.any())
        return Solution(value, status, end.steps, residual, operator.curvature, operator.products, warm)


def _verified(claimed: Status, residual: float, rtol: float) -> Status:
    """Replace a claimed status by what the recomputed residual shows."""
    if residual <= rtol and claimed is not Status.SINGULAR:
        return Status.CONVERGED
    return Status.STAGNATED if claimed is Status.CONVERGED else claimed


def _power_of_two(size: float) -> float:
    """Find the largest power of two that does not exceed ``size``.

    Scaling by it is exact, so relative residuals do not change.
    """
    return 2.0 ** (math.frexp(size)[1] - 1)


def _lost(claimed: Status) -> Status:
    return Status.STAGNATED if claimed in (Status.CONVERGED, Status.MAX_STEPS) else claimed


def _scaled(x0: Tensor | Search | None, scale: float, unit: float) -> Tensor | Search | None:
    if isinstance(x0, Search):
        return x0.divided(scale).divided(unit)
    return None if x0 is None else x0 / scale / unit


def _started(
    operator: Watched,
    rhs: Float[Tensor, "n"],
    guess: Tensor | Search | None,
    tolerance: float,
    max_steps: int,
) -> System:
    """Start at the guess if it beats zero, whose relative residual is 1; otherwise start at zero."""
    cold = System(operator, rhs, torch.zeros_like(rhs), rhs, None, tolerance, max_steps)
    value = guess.value if isinstance(guess, Search) else guess
    if value is None or not bool(torch.isfinite(value).all()) or not bool(value.any()):
        return cold
    if isinstance(guess, Search) and tolerance < norm(guess.residual) < norm(rhs):
        return replace(cold, start=value, residual=guess.residual, direction=guess.direction)
    try:
        residual = rhs - operator(value)
    except NonFiniteProduct:
        logger.info("warm start dropped: its product is not finite")
        return cold
    if norm(residual) < norm(rhs):
        return replace(cold, start=value, residual=residual)
    logger.info(
        "warm start dropped: its relative residual is %.3g, that of zero is 1", norm(residual) / norm(rhs)
    )
    return cold


def _check(b: Tensor, x0: Tensor | None, rtol: float, max_steps: int) -> None:
    if b.ndim != 1 or b.numel() == 0:
        raise ValueError(f"solve: b must be a non-empty vector, got shape {tuple(b.shape)}")
    if not b.is_floating_point():
        raise ValueError(f"solve: b must be floating point, got {b.dtype}")
    if x0 is not None and x0.shape != b.shape:
        raise ValueError(f"solve: x0 has shape {tuple(x0.shape)}, b has {tuple(b.shape)}")
    if not 0.0 <= rtol < 1.0:
        raise ValueError(f"solve: rtol must lie in [0, 1), got {rtol}")
    if max_steps < 1:
        raise ValueError(f"solve: max_steps must be at least 1, got {max_steps}")
