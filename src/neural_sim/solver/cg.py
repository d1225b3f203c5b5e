"""Conjugate gradients (Hestenes and Stiefel 1952) that keep the best iterate and name non-positive curvature."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neural_sim.solver.base import Iterate, LinearSolver, System, check_restart_gain
from neural_sim.solver.operator import Matvec, dot, norm
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class ConjugateGradient(LinearSolver):
    """For positive definite operators. ``restart_gain``: when the recursion says converged and the recomputed
    residual does not, iteration restarts from the true one as long as a restart shrinks it by this factor.
    """

    restart_gain: float = 0.5

    def __post_init__(self) -> None:
        check_restart_gain("cg", self.restart_gain)

    def iterate(self, system: System) -> Iterate:
        return conjugate_gradients(system, self.restart_gain)


def conjugate_gradients(
    system: System, restart_gain: float, precondition: Matvec = lambda residual: residual
) -> Iterate:
    """The iteration itself; ``precondition`` applies a positive definite approximation of the inverse."""
    operator, rhs, tolerance = system.operator, system.rhs, system.tolerance
    value = best = system.start
    residual = system.first_residual()
    confirmed = best_norm = norm(residual)
    if confirmed <= tolerance:
        return Iterate(best, Status.CONVERGED, 0)
    direction = precondition(residual)
    energy = dot(residual, direction)
    for step in range(1, system.max_steps + 1):
        product = operator(direction)
        curvature = dot(direction, product)
        # For positive definite A the cosine of p and Ap is at least 2 sqrt(kappa) / (kappa + 1) (Kantorovich), so one
        # below machine epsilon is curvature that rounding cannot tell from zero.
        if curvature <= torch.finfo(rhs.dtype).eps * norm(direction) * norm(product):
            return Iterate(best, Status.NEGATIVE_CURVATURE, step)
        alpha = energy / curvature
        value = value + alpha * direction
        residual = residual - alpha * product
        size = norm(residual)
        if size < best_norm:
            best, best_norm = value, size
        restart = size <= tolerance
        if restart:
            residual = rhs - operator(value)
            true = norm(residual)
            if true <= tolerance:
                return Iterate(value, Status.CONVERGED, step)
            if true > restart_gain * confirmed:
                return Iterate(value, Status.STAGNATED, step)
            confirmed = best_norm = true
            best = value
        conditioned = precondition(residual)
        before, energy = energy, dot(residual, conditioned)
        direction = conditioned if restart else conditioned + (energy / before) * direction
    return Iterate(best, Status.MAX_STEPS, system.max_steps)
