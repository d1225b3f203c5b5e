"""The minimum residual method (Paige and Saunders 1975), for symmetric operators, even indefinite or singular ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.ranges import validated
from neural_sim.solver.base import Iterate, LinearSolver, RestartGain, Status, System
from neural_sim.solver.operator import Watched, dot, norm


@validated
@dataclass(frozen=True)
class MinimumResidual(LinearSolver):
    """The minimum residual method (MINRES), for any symmetric operator.

    The residual falls monotonically. On an inconsistent singular system the method ends at a least-squares solution and
    says so. For ``restart_gain`` see ``ConjugateGradient``.
    """

    restart_gain: RestartGain = 0.5

    @override
    def iterate(self, system: System) -> Iterate:
        operator, rhs, tolerance = system.operator, system.rhs, system.tolerance
        value, steps = system.start, 0
        residual = system.residual
        size = norm(residual)
        while size > tolerance:
            if steps >= system.max_steps:
                return Iterate(value, Status.MAX_STEPS, steps, size)
            cycle = _cycle(operator, residual, tolerance, system.max_steps - steps)
            steps += cycle.steps
            candidate = value + cycle.value
            after = rhs - operator(candidate)
            reached = norm(after)
            if cycle.least is not None and reached > self.restart_gain * cycle.least_norm:
                least = value + cycle.least
                left = rhs - operator(least)
                if norm(left) > tolerance and _minimises(operator, left):
                    return Iterate(least, Status.LEAST_SQUARES, steps, norm(left))
                if norm(left) < reached:
                    candidate, after, reached = least, left, norm(left)
            if reached > max(tolerance, (self.restart_gain if cycle.converged else 1.0) * size):
                if reached < size:
                    return Iterate(candidate, Status.STAGNATED, steps, reached)
                return Iterate(value, Status.STAGNATED, steps)
            value, residual, size = candidate, after, reached
        return Iterate(value, Status.CONVERGED, steps, size)


def _minimises(operator: Watched, residual: Float[Tensor, "n"]) -> bool:
    """Check that ``|A r| <= 10 sqrt(eps) |A| |r|`` for the true residual.

    The recurrence estimates this as well, but above a condition number of 1 / sqrt(eps), rounding keeps the true
    residual from reaching that estimate.
    """
    limit = 10.0 * torch.finfo(residual.dtype).eps ** 0.5 * max(abs(end) for end in operator.curvature)
    return norm(operator(residual)) <= limit * norm(residual)


@dataclass(frozen=True)
class _Cycle:
    """One run from a residual. ``least`` is an iterate whose residual was nearly orthogonal to the range, if any."""

    value: Float[Tensor, "n"]
    converged: bool
    steps: int
    least: Float[Tensor, "n"] | None
    least_norm: float


def _cycle(operator: Watched, residual: Float[Tensor, "n"], tolerance: float, budget: int) -> _Cycle:
    """Run the Lanczos recurrence with Givens rotations on the tridiagonal matrix, until ``|r| <= tolerance``."""
    eta = norm(residual)  # the residual norm with its sign: last entry of the rotated right-hand side
    basis, before = residual / eta, torch.zeros_like(residual)
    direction, older = torch.zeros_like(residual), torch.zeros_like(residual)
    value = torch.zeros_like(residual)
    beta, cosine, sine, cosine_before, sine_before, largest = 0.0, 1.0, 0.0, 1.0, 0.0, 0.0
    least, least_norm, lowest = None, math.inf, math.inf
    half_digits = torch.finfo(residual.dtype).eps ** 0.5
    for step in range(1, budget + 1):
        product = operator(basis) - beta * before
        alpha = dot(basis, product)
        product = product - alpha * basis
        beta_next = norm(product)
        largest = max(largest, math.hypot(beta, alpha, beta_next))
        carried = cosine_before * beta
        diagonal = cosine * alpha - sine * carried
        upper, upper_two = cosine * carried + sine * alpha, sine_before * beta
        # |A r| / |r| of the iterate so far (Choi, Paige and Saunders 2011). Where it nearly vanishes, the residual lies
        # outside the range of A, or along eigenvalues below sqrt(eps) |A|; more steps tell which.
        slope = math.hypot(diagonal, cosine * beta_next) / largest if largest > 0.0 else 0.0
        if slope <= min(half_digits, lowest):
            least, least_norm, lowest = value, abs(eta), slope
        rotated = math.hypot(diagonal, beta_next)
        bounced = least is not None and slope > 1e4 * half_digits and abs(eta) > 0.5 * least_norm
        if rotated == 0.0 or bounced:
            return _Cycle(value, False, step, least, least_norm)
        cosine_before, sine_before = cosine, sine
        cosine, sine = diagonal / rotated, beta_next / rotated
        direction, older = (basis - upper_two * older - upper * direction) / rotated, direction
        value = value + (cosine * eta) * direction
        eta = -sine * eta
        if abs(eta) <= tolerance or beta_next == 0.0:
            return _Cycle(value, True, step, least, least_norm)
        before, basis, beta = basis, product / beta_next, beta_next
    return _Cycle(value, False, budget, least, least_norm)
