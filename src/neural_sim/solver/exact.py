"""The dense solve, an oracle for small problems: every column of the matrix costs one product."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Iterate, LinearSolver, System
from neural_sim.solver.operator import norm
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class Exact(LinearSolver):
    """By eigenvalues: any symmetric system (minimum norm on the range of a singular one), the extreme eigenvalues
    being the curvature. ``max_steps`` does not bind. Systems above ``max_size`` raise ``ValueError``.
    """

    max_size: int = 5000

    def iterate(self, system: System) -> Iterate:
        operator, rhs, size = system.operator, system.rhs, system.rhs.numel()
        if size > self.max_size:
            raise ValueError(
                f"exact: got {size} unknowns, max_size is {self.max_size}; use an iterative solver"
            )
        matrix = operator.dense(rhs)
        # Products may be unsymmetric by rounding. Halves first: a sum of entries near the largest float overflows.
        matrix = 0.5 * matrix + 0.5 * matrix.T
        scale = float(matrix.abs().max())
        if scale == 0.0:
            return Iterate(torch.zeros_like(rhs), Status.LEAST_SQUARES, 1)
        values, vectors = torch.linalg.eigh(matrix / scale)
        operator.observe(float(values[0]) * scale, float(values[-1]) * scale)
        kept = values.abs() > values.numel() * torch.finfo(values.dtype).eps * values.abs().max()
        inverted = torch.where(
            kept, 1.0 / torch.where(kept, values, torch.ones_like(values)), torch.zeros_like(values)
        )

        def inverse(vector: Tensor) -> Tensor:
            return vectors @ (inverted * (vectors.T @ vector)) / scale

        value = _refined(inverse, matrix, rhs)
        if bool(kept.all()):
            return Iterate(value, Status.CONVERGED, 1)
        consistent = norm(rhs - matrix @ value) <= max(system.tolerance, torch.finfo(rhs.dtype).eps ** 0.5)
        return Iterate(value, Status.SINGULAR if consistent else Status.LEAST_SQUARES, 1)


def _refined(inverse, matrix: Float[Tensor, "n n"], rhs: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """One step of iterative refinement on the factorisation's answer, kept if it lowers the residual."""
    value = inverse(rhs)
    better = value + inverse(rhs - matrix @ value)
    return better if norm(rhs - matrix @ better) < norm(rhs - matrix @ value) else value
