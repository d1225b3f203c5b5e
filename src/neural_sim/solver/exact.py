"""The dense solve, an oracle for small problems: every column of the matrix costs one product."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Iterate, LinearSolver, System
from neural_sim.solver.operator import Watched, norm
from neural_sim.solver.solution import Status

Method = Literal["eigen", "cholesky"]


@dataclass(frozen=True)
class Exact(LinearSolver):
    """``eigen`` solves any symmetric system (minimum norm on the range of a singular one) and reports the
    extreme eigenvalues as curvature; ``cholesky`` is an order faster and wants a positive definite one.
    ``max_steps`` does not bind. Systems above ``max_size`` raise ``ValueError``.
    """

    method: Method = "eigen"
    max_size: int = 5000

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise ValueError(f"exact: method must be one of {get_args(Method)}, got {self.method!r}")

    def iterate(self, system: System) -> Iterate:
        operator, rhs, size = system.operator, system.rhs, system.rhs.numel()
        if size > self.max_size:
            raise ValueError(
                f"exact: got {size} unknowns, max_size is {self.max_size}; use an iterative solver"
            )
        matrix = operator.dense(rhs)
        # Products may be unsymmetric by rounding. Halves first: a sum of entries near the largest float overflows.
        matrix = 0.5 * matrix + 0.5 * matrix.T
        return (
            self._cholesky(matrix, rhs)
            if self.method == "cholesky"
            else self._eigen(operator, matrix, rhs, system.tolerance)
        )

    def _cholesky(self, matrix: Float[Tensor, "n n"], rhs: Float[Tensor, "n"]) -> Iterate:
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if int(failed) > 0:
            return Iterate(torch.zeros_like(rhs), Status.NEGATIVE_CURVATURE, 1)

        def inverse(vector: Tensor) -> Tensor:
            return torch.cholesky_solve(vector[:, None], factor)[:, 0]

        return Iterate(_refined(inverse, matrix, rhs), Status.CONVERGED, 1)

    def _eigen(self, operator: Watched, matrix: Tensor, rhs: Tensor, tolerance: float) -> Iterate:
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
        consistent = norm(rhs - matrix @ value) <= max(tolerance, torch.finfo(rhs.dtype).eps ** 0.5)
        return Iterate(value, Status.SINGULAR if consistent else Status.LEAST_SQUARES, 1)


def _refined(inverse, matrix: Float[Tensor, "n n"], rhs: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """One step of iterative refinement on the factorisation's answer, kept if it lowers the residual."""
    value = inverse(rhs)
    better = value + inverse(rhs - matrix @ value)
    return better if norm(rhs - matrix @ better) < norm(rhs - matrix @ value) else value
