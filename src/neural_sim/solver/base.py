"""The frame all solvers share: scaling, warm start, true residual, status. Each solver adds its iteration."""

from __future__ import annotations

import abc
import logging
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.operator import Matvec, NonFiniteProduct, Watched, norm
from neural_sim.solver.solution import Solution, Status

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Iterate:
    """Where an iteration stopped; CONVERGED here is a claim that ``LinearSolver.solve`` checks."""

    value: Float[Tensor, "n"]
    status: Status
    steps: int


@dataclass(frozen=True)
class System:
    """``operator x = rhs`` as a solver's iteration gets it: ``rhs`` has a norm in [1, 2), ``tolerance`` is absolute."""

    operator: Watched
    rhs: Float[Tensor, "n"]
    start: Float[Tensor, "n"]
    tolerance: float
    max_steps: int

    def first_residual(self) -> Float[Tensor, "n"]:
        """The residual at ``start``, without a product where that is zero."""
        return self.rhs - self.operator(self.start) if bool(self.start.any()) else self.rhs


@dataclass(frozen=True)
class LinearSolver(abc.ABC):
    """Solves ``A x = b`` for symmetric A given by its products. Subclasses hold typed hyper-parameters."""

    @abc.abstractmethod
    def iterate(self, system: System) -> Iterate:
        """Iterate until the residual's norm is at most the system's tolerance or its steps are spent."""

    def solve(
        self,
        matvec: Matvec,
        b: Float[Tensor, "n"],
        x0: Float[Tensor, "n"] | None = None,
        rtol: float = 1e-3,
        max_steps: int = 40,
    ) -> Solution:
        """Solve to ``|b - A x| <= rtol |b|`` in at most ``max_steps`` steps, starting from ``x0`` (default
        0).

        Bad numbers give a status, never a NaN. Raises ``ValueError`` for shapes and settings that make no
        sense.
        """
        _check(b, x0, rtol, max_steps)
        operator = Watched(matvec)
        scale = float(b.abs().max())
        if scale == 0.0:
            return Solution(torch.zeros_like(b), Status.CONVERGED, 0, 0.0, (0.0, 0.0), 0, False)
        failed = Solution(torch.zeros_like(b), Status.NON_FINITE, 0, 1.0, (0.0, 0.0), 0, False)
        if not bool(torch.isfinite(b).all()):
            return failed
        scale = _power_of_two(scale)
        rhs = b / scale  # the norm of b itself would overflow float32 at 1e20 and underflow at 1e-30
        unit = _power_of_two(norm(rhs))
        rhs = rhs / unit
        size = norm(rhs)
        start = _warm_start(operator, rhs, None if x0 is None else x0 / scale / unit)
        try:
            end = self.iterate(System(operator, rhs, start, rtol * size, max_steps))
            residual = norm(rhs - operator(end.value)) / size
        except NonFiniteProduct as error:
            logger.warning("%s: %s", type(self).__name__, error)
            return Solution(
                failed.value, Status.NON_FINITE, 0, 1.0, operator.curvature, operator.products, False
            )
        if residual > 1.0 and end.status is not Status.APPROXIMATE:
            # Rounding made the recursion lose touch with the true residual: zero is the better answer.
            logger.warning("%s: the true residual is %.3g; zero is returned", type(self).__name__, residual)
            end, residual = Iterate(torch.zeros_like(rhs), _lost(end.status), end.steps), 1.0
        value = end.value * unit * scale
        if not bool(torch.isfinite(value).all()):
            return Solution(
                failed.value, Status.NON_FINITE, end.steps, 1.0, operator.curvature, operator.products, False
            )
        status = _verified(end.status, residual, rtol)
        warm = bool(start.any())
        return Solution(value, status, end.steps, residual, operator.curvature, operator.products, warm)


def _verified(claimed: Status, residual: float, rtol: float) -> Status:
    """The status that the recomputed residual supports."""
    if residual <= rtol and claimed is not Status.SINGULAR:
        return Status.CONVERGED
    return Status.STAGNATED if claimed is Status.CONVERGED else claimed


def _power_of_two(size: float) -> float:
    """The power of two below ``size``: scaling by it is exact, so the scaled residual is the original one's."""
    return 2.0 ** (math.frexp(size)[1] - 1)


def _lost(claimed: Status) -> Status:
    return Status.STAGNATED if claimed in (Status.CONVERGED, Status.MAX_STEPS) else claimed


def _warm_start(
    operator: Watched, rhs: Float[Tensor, "n"], guess: Float[Tensor, "n"] | None
) -> Float[Tensor, "n"]:
    """The guess where its residual beats that of zero (which is 1), else zero."""
    zero = torch.zeros_like(rhs)
    if guess is None or not bool(torch.isfinite(guess).all()) or not bool(guess.any()):
        return zero
    try:
        residual = norm(rhs - operator(guess)) / norm(rhs)
    except NonFiniteProduct:
        logger.info("warm start dropped: its product is not finite")
        return zero
    if residual < 1.0:
        return guess
    logger.info("warm start dropped: its relative residual is %.3g, that of zero is 1", residual)
    return zero


def check_restart_gain(solver: str, restart_gain: float) -> None:
    """Raises ``ValueError`` unless the factor by which a restart must shrink the residual lies in (0, 1)."""
    if not 0.0 < restart_gain < 1.0:
        raise ValueError(f"{solver}: restart_gain must lie in (0, 1), got {restart_gain}")


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
