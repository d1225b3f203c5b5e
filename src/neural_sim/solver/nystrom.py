"""Low-rank inverse by the Nystrom method (Hataya and Yamada 2023): ``H ~ C core^+ C^T`` and Woodbury's identity."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Iterate, LinearSolver, System
from neural_sim.solver.cg import conjugate_gradients
from neural_sim.solver.operator import Watched
from neural_sim.solver.solution import Status

Sketch = Literal["columns", "gaussian"]


@dataclass(frozen=True)
class Nystrom(LinearSolver):
    """For ``A = H + shift I`` with H near low rank: ``rank`` products build ``A^-1`` once, no iteration
    needed.

    Args:
        rank: products spent on the sketch (no more than half of max_steps where refinement is on).
        sketch: ``columns`` of H at random (as there), or products with ``gaussian`` vectors (Frangella et al. 2023).
        refine: use what is left of max_steps for ``x += P (b - A x)`` while the residual falls.
        shift: the multiple of the identity in A; None reads it off a ``Shifted`` operator.
        seed: of the sketch's generator, so that the same system gives the same answer.

    ``solve`` raises ``ValueError`` where the shift is not positive: the approximation has no inverse then.
    """

    rank: int = 10
    sketch: Sketch = "columns"
    refine: bool = True
    shift: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rank < 1:
            raise ValueError(f"nystrom: rank must be at least 1, got {self.rank}")
        if self.sketch not in get_args(Sketch):
            raise ValueError(f"nystrom: sketch must be one of {get_args(Sketch)}, got {self.sketch!r}")

    def iterate(self, system: System) -> Iterate:
        operator, rhs, max_steps = system.operator, system.rhs, system.max_steps
        shift = operator.shift if self.shift is None else self.shift
        if not shift > 0.0:
            raise ValueError(f"nystrom: want a positive damping in the operator, got {shift}")
        rank = min(self.rank, rhs.numel(), max(1, max_steps // 2) if self.refine else max_steps)
        basis, values = self._low_rank(operator, rhs, shift, rank)
        if bool((values + shift <= 0.0).any()):
            return Iterate(system.start, Status.NEGATIVE_CURVATURE, rank)
        gain = 1.0 / (values + shift) - 1.0 / shift

        def inverse(vector: Tensor) -> Tensor:
            return vector / shift + basis @ (gain * (basis.T @ vector))

        if not self.refine:
            return Iterate(inverse(rhs), Status.APPROXIMATE, rank)
        left = replace(system, max_steps=max(1, max_steps - rank))
        end = conjugate_gradients(left, 0.5, inverse)
        return Iterate(end.value, end.status, end.steps + rank)

    def _low_rank(
        self, operator: Watched, rhs: Tensor, shift: float, rank: int
    ) -> tuple[Float[Tensor, "n r"], Float[Tensor, "r"]]:
        """Orthonormal vectors and eigenvalues of the Nystrom approximation of H."""
        probes = self._probes(rhs, rank)
        products = torch.stack([operator(probe) - shift * probe for probe in probes.T], -1)
        core = probes.T @ products
        weights, rotation = torch.linalg.eigh(0.5 * core + 0.5 * core.T)
        # The pseudo-inverse of the core; directions that rounding cannot tell from zero are dropped.
        kept = weights.abs() > rank * torch.finfo(rhs.dtype).eps ** 0.75 * weights.abs().max()
        if not bool(kept.any()):
            return rhs.new_zeros(rhs.numel(), 1), rhs.new_zeros(1)
        half = products @ rotation[:, kept] / weights[kept].abs().sqrt()
        orthonormal, triangle = torch.linalg.qr(half)
        values, vectors = torch.linalg.eigh(triangle @ (weights[kept].sign()[:, None] * triangle.T))
        return orthonormal @ vectors, values

    def _probes(self, rhs: Tensor, rank: int) -> Float[Tensor, "n r"]:
        generator = torch.Generator().manual_seed(self.seed)
        if self.sketch == "columns":
            chosen = torch.randperm(rhs.numel(), generator=generator)[:rank].to(rhs.device)
            probes = rhs.new_zeros(rhs.numel(), rank)
            probes[chosen, torch.arange(rank, device=rhs.device)] = 1.0
            return probes
        gaussian = torch.randn(rhs.numel(), rank, generator=generator, dtype=rhs.dtype).to(rhs.device)
        return torch.linalg.qr(gaussian).Q
