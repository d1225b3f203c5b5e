"""The truncated Neumann series ``eta sum_i (I - eta A)^i b`` (Lorraine et al. 2020), eta from Lanczos."""

from __future__ import annotations

from dataclasses import dataclass

from neural_sim.solver.base import Iterate, LinearSolver, System
from neural_sim.solver.lanczos import lanczos
from neural_sim.solver.operator import NonFiniteProduct, norm
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class Neumann(LinearSolver):
    """For positive definite operators; needs of the order of the condition number steps.

    ``scale`` is ``eta lambda_max``, below 2 for convergence (1: safe where lambda_max is slightly too small).
    ``lanczos_steps`` products from the residual itself estimate lambda_max of the part that matters.
    """

    scale: float = 1.0
    lanczos_steps: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.scale < 2.0 or self.lanczos_steps < 1:
            raise ValueError(
                f"neumann: want scale in (0, 2) and lanczos_steps >= 1, got {self.scale}, {self.lanczos_steps}"
            )

    def iterate(self, system: System) -> Iterate:
        operator, rhs, tolerance = system.operator, system.rhs, system.tolerance
        value = best = system.start
        residual = system.residual
        smallest = size = norm(residual)
        if size <= tolerance:
            return Iterate(system.start, Status.CONVERGED, 0)
        spectrum = lanczos(operator, residual, self.lanczos_steps)
        if not spectrum.finite:
            raise NonFiniteProduct("the operator is not finite on the Lanczos vectors")
        if spectrum.smallest <= 0.0:
            return Iterate(system.start, Status.NEGATIVE_CURVATURE, 0)
        rate = self.scale / (spectrum.largest + spectrum.largest_error)
        for step in range(1, system.max_steps + 1):
            value = value + rate * residual
            residual = rhs - operator(value)
            size = norm(residual)
            if size < smallest:
                best, smallest = value, size
            if size <= tolerance:
                return Iterate(value, Status.CONVERGED, step)
            if operator.curvature[0] <= 0.0:
                return Iterate(best, Status.NEGATIVE_CURVATURE, step)
            if size > 10.0 * smallest:
                return Iterate(best, Status.DIVERGED, step)
        return Iterate(best, Status.MAX_STEPS, system.max_steps)
