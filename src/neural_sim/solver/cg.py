"""Conjugate gradients (Hestenes and Stiefel 1952) that keep the best iterate and report non-positive curvature."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from typing_extensions import override

from neural_sim.ranges import validated
from neural_sim.solver.base import Iterate, LinearSolver, RestartGain, Status, System
from neural_sim.solver.operator import dot, in_range, norm, numbers, plain_dot, plain_norm


@validated
@dataclass(frozen=True)
class ConjugateGradient(LinearSolver):
    """Conjugate gradients, for positive definite operators.

    ``restart_gain``: when the recurrence's residual has converged and the recomputed one has not, the iteration
    restarts from the recomputed one, as long as each restart leaves at most this fraction of it.
    """

    restart_gain: RestartGain = 0.5

    @override
    def iterate(self, system: System) -> Iterate:
        operator, rhs, tolerance = system.operator, system.rhs, system.tolerance
        value = best = system.start
        residual = system.residual
        confirmed = best_norm = norm(residual)
        if confirmed <= tolerance:
            return Iterate(best, Status.CONVERGED, 0, confirmed)
        # A given direction continues an earlier search.
        direction = residual if system.direction is None else system.direction
        energy = dot(residual, residual)
        for step in range(1, system.max_steps + 1):
            product = operator.measured(direction)
            # For positive definite A the cosine of p and Ap is at least 2 sqrt(kappa) / (kappa + 1) (Kantorovich),
            # so a cosine below machine epsilon means curvature that rounding cannot tell from zero.
            if product.energy <= torch.finfo(rhs.dtype).eps * product.size * product.length:
                return Iterate(best, Status.NEGATIVE_CURVATURE, step)
            alpha = energy / product.energy
            value = value + alpha * direction
            residual = residual - alpha * product.value
            before = energy
            size, energy = numbers(plain_norm(residual), plain_dot(residual, residual))
            size = in_range(size, residual)
            if size < best_norm:
                best, best_norm = value, size
            restart = size <= tolerance
            if restart:
                residual = rhs - operator(value)
                true = norm(residual)
                if true <= tolerance:
                    return Iterate(value, Status.CONVERGED, step, true)
                if true > self.restart_gain * confirmed:
                    return Iterate(value, Status.STAGNATED, step, true)
                confirmed = best_norm = true
                best = value
                energy = dot(residual, residual)
            direction = residual if restart else residual + (energy / before) * direction
        return Iterate(best, Status.MAX_STEPS, system.max_steps)
