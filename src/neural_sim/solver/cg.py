"""Conjugate gradients (Hestenes and Stiefel 1952) that keep the best iterate and name non-positive curvature."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neural_sim.solver.base import Iterate, LinearSolver, System, check_restart_gain
from neural_sim.solver.operator import Matvec, dot, in_range, norm, numbers, plain_dot, plain_norm
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class ConjugateGradient(LinearSolver):
    """For positive definite operators. ``restart_gain``: where the recursion's residual converges and the recomputed
    one does not, iteration restarts from the latter, as long as each restart shrinks it by this factor.
    """

    restart_gain: float = 0.5

    def __post_init__(self) -> None:
        check_restart_gain("cg", self.restart_gain)

    def iterate(self, system: System) -> Iterate:
        return conjugate_gradients(system, self.restart_gain)


def conjugate_gradients(system: System, restart_gain: float, precondition: Matvec | None = None) -> Iterate:
    """The iteration itself; ``precondition`` applies a positive definite approximation of the inverse.

    A system with a search's direction continues that search; with a preconditioner, whose directions differ, it does
    not.
    """
    operator, rhs, tolerance = system.operator, system.rhs, system.tolerance
    value = best = system.start
    residual = system.residual
    confirmed = best_norm = norm(residual)
    if confirmed <= tolerance:
        return Iterate(best, Status.CONVERGED, 0, confirmed)
    conditioned = residual if precondition is None else precondition(residual)
    begun = system.direction if precondition is None else None
    direction = conditioned if begun is None else begun
    energy = dot(residual, conditioned)
    for step in range(1, system.max_steps + 1):
        product = operator.measured(direction)
        # For positive definite A the cosine of p and Ap is at least 2 sqrt(kappa) / (kappa + 1) (Kantorovich), so one
        # below machine epsilon is curvature that rounding cannot tell from zero.
        if product.energy <= torch.finfo(rhs.dtype).eps * product.size * product.length:
            return Iterate(best, Status.NEGATIVE_CURVATURE, step)
        alpha = energy / product.energy
        value = value + alpha * direction
        residual = residual - alpha * product.value
        conditioned = residual if precondition is None else precondition(residual)
        before = energy
        size, energy = numbers(plain_norm(residual), plain_dot(residual, conditioned))
        size = in_range(size, residual)
        if size < best_norm:
            best, best_norm = value, size
        restart = size <= tolerance
        if restart:
            residual = rhs - operator(value)
            true = norm(residual)
            if true <= tolerance:
                return Iterate(value, Status.CONVERGED, step, true)
            if true > restart_gain * confirmed:
                return Iterate(value, Status.STAGNATED, step, true)
            confirmed = best_norm = true
            best = value
            conditioned = residual if precondition is None else precondition(residual)
            energy = dot(residual, conditioned)
        direction = conditioned if restart else conditioned + (energy / before) * direction
    return Iterate(best, Status.MAX_STEPS, system.max_steps)
