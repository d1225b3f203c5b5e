"""Solvers without an iteration: a dense factorisation, and a multiple of the identity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.ranges import Matching, PositiveInt, validated
from neural_sim.solver.base import Iterate, LinearSolver, Status, System
from neural_sim.solver.operator import eigenpairs, norm


@validated
@dataclass(frozen=True)
class Exact(LinearSolver):
    """A dense eigenvalue solve, the reference for small problems: every column of the matrix costs one product.

    It solves any symmetric system (a singular one by minimum norm on its range). The extreme eigenvalues are reported
    as the curvature. ``max_steps`` does not apply. Systems above ``max_size`` raise ``ValueError``.
    """

    iterative: ClassVar[bool] = False
    max_size: PositiveInt = 5000

    @property
    @override
    def largest(self) -> int:
        return self.max_size

    @override
    def iterate(self, system: System) -> Iterate:
        operator, rhs, size = system.operator, system.rhs, system.rhs.numel()
        if size > self.max_size:
            raise ValueError(
                f"exact: got {size} unknowns, max_size is {self.max_size}; use an iterative solver"
            )
        matrix = operator.dense(rhs)
        # Rounding may leave the products asymmetric. Halving first keeps the sum of huge entries from overflowing.
        matrix = 0.5 * matrix + 0.5 * matrix.T
        scale = float(matrix.abs().max())
        if scale == 0.0:
            return Iterate(torch.zeros_like(rhs), Status.LEAST_SQUARES, 1)
        values, vectors = eigenpairs(matrix / scale)
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


def _refined(
    inverse: Callable[[Tensor], Tensor], matrix: Float[Tensor, "n n"], rhs: Float[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Refine the factorisation's answer once, and keep the result if its residual is lower."""
    value = inverse(rhs)
    better = value + inverse(rhs - matrix @ value)
    return better if norm(rhs - matrix @ better) < norm(rhs - matrix @ value) else value


@validated
@dataclass(frozen=True)
class Identity(LinearSolver):
    """``x = scale b``, the one-step choice T1-T2 (Luketina et al. 2016). One product is spent on the residual."""

    iterative: ClassVar[bool] = False
    scale: Annotated[float, Matching(bool, "a number other than 0")] = 1.0

    @override
    def iterate(self, system: System) -> Iterate:
        return Iterate(self.scale * system.rhs, Status.APPROXIMATE, 0)
