"""Conjugate gradients (Hestenes and Stiefel 1952) that keep the best iterate and name non-positive curvature."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Iterate, LinearSolver
from neural_sim.solver.operator import Watched, dot, norm
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class ConjugateGradient(LinearSolver):
    """For positive definite operators. ``restart_gain``: when the recursion says converged and the recomputed
    residual does not, iteration restarts from the true one as long as a restart shrinks it by this factor.
    """

    restart_gain: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.restart_gain < 1.0:
            raise ValueError(f"cg: restart_gain must lie in (0, 1), got {self.restart_gain}")

    def iterate(
        self,
        operator: Watched,
        rhs: Float[Tensor, "n"],
        start: Float[Tensor, "n"],
        rtol: float,
        max_steps: int,
    ) -> Iterate:
        value = best = start
        residual = rhs - operator(start) if bool(start.any()) else rhs
        confirmed = best_norm = norm(residual)
        direction, squared = residual, confirmed**2
        if confirmed <= rtol:
            return Iterate(best, Status.CONVERGED, 0)
        for step in range(1, max_steps + 1):
            product = operator(direction)
            curvature = dot(direction, product)
            # For positive definite A the cosine of p and Ap is at least 2 sqrt(kappa) / (kappa + 1) (Kantorovich),
            # so one below machine epsilon is curvature that rounding cannot tell from zero.
            if curvature <= torch.finfo(rhs.dtype).eps * norm(direction) * norm(product):
                return Iterate(best, Status.NEGATIVE_CURVATURE, step)
            alpha = squared / curvature
            value = value + alpha * direction
            residual = residual - alpha * product
            size = norm(residual)
            if size < best_norm:
                best, best_norm = value, size
            beta = size**2 / squared
            if size <= rtol:
                residual = rhs - operator(value)
                true = norm(residual)
                if true <= rtol:
                    return Iterate(value, Status.CONVERGED, step)
                if true > self.restart_gain * confirmed:
                    return Iterate(value, Status.STAGNATED, step)
                confirmed = best_norm = size = true
                best, beta = value, 0.0
            direction, squared = residual + beta * direction, size**2
        return Iterate(best, Status.MAX_STEPS, max_steps)
