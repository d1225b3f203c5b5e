"""The hypergradient at a stationary point of the inner problem (Eq. 2).

``dL_val/dpsi = - d/dpsi <dL_train/dtheta, v>`` with ``(H + lambda I) v = dL_val/dtheta``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.detector.losses import proximal_loss
from neural_sim.gradient.base import IndexedLoss, MixedDerivative, Params
from neural_sim.gradient.hypergradient import Hypergradient, ImplicitAdjoint
from neural_sim.ranges import NonNegative, NonNegativeInt, validated
from neural_sim.solver.adjoint import Adjoint, AdjointSolver
from neural_sim.solver.base import Status
from neural_sim.solver.hvp import Term, gradient
from neural_sim.solver.operator import norm, unflatten

Estimate = Callable[[Params], MixedDerivative]
FAILED = (Status.NEGATIVE_CURVATURE, Status.NON_FINITE)


@validated
@dataclass(frozen=True)
class Implicit:
    """``outer.adjoint``: the hypergradient at a stationary point, with the solver from the group ``solver``.

    Args:
        curvature_images: number of training images in the Hessian products; 0: all.
        max_residual: largest trusted relative residual of the solve; None: no limit.
    """

    curvature_images: NonNegativeInt = 64
    max_residual: NonNegative | None = 0.1

    def doubts(self, adjoint: ImplicitAdjoint) -> list[str]:
        """Name the conditions that a solve fails."""
        solution = adjoint.solution
        failed = ["solver"] if solution.status in FAILED else []
        # solver=identity never iterates: whoever chooses it accepts its residual.
        if solution.status is Status.APPROXIMATE or self.max_residual is None:
            return failed
        return failed + ["residual"] * (solution.residual > self.max_residual)


@dataclass(frozen=True)
class InnerProblem:
    """``L_train(theta) = sum_i w_i l_i(theta) + proximal / 2 |theta - anchor|^2`` near its minimiser ``params``.

    Attributes:
        params: theta.
        losses: l_i by row.
        weights: w_i of rows 0..N-1 of ``losses``; 1 / N each without photographs.
        chunk_size: number of images in memory at a time.
        proximal: weight of the proximal term. With it, the exact implicit derivative has ``(H + proximal I)^-1``, where
            H is the Hessian of the losses.
        anchor: the fixed theta_0 of the proximal term.
        subset: rows used in Hessian products (the stationarity uses all rows); None: all.
        subset_weights: weights of those rows; None: their own weights, scaled to the total of all rows.

    Raises:
        ValueError: no weights, a ``chunk_size`` below 1, or a proximal term that is negative or lacks its anchor.
    """

    params: Params
    losses: IndexedLoss
    weights: Float[Tensor, "N"]
    chunk_size: int = 64
    proximal: float = 0.0
    anchor: Params | None = None
    subset: Int[Tensor, "n"] | None = None
    subset_weights: Float[Tensor, "n"] | None = None

    def __post_init__(self) -> None:
        if self.weights.ndim != 1 or self.weights.numel() == 0:
            raise ValueError(
                f"inner problem: weights must be a non-empty vector, got {tuple(self.weights.shape)}"
            )
        if self.chunk_size < 1 or self.proximal < 0.0:
            raise ValueError(
                f"inner problem: want chunk_size >= 1 and proximal >= 0, got {self.chunk_size}, {self.proximal}"
            )
        if self.proximal > 0.0 and self.anchor is None:
            raise ValueError("inner problem: a proximal term needs its anchor theta_0")

    def terms(
        self, subset: Int[Tensor, "n"] | None = None, subset_weights: Float[Tensor, "n"] | None = None
    ) -> list[Term]:
        """Return the loss as a sum of chunks and the proximal term, over all rows or a subset that represents them."""
        index = torch.arange(self.weights.numel(), device=self.weights.device) if subset is None else subset
        weights = self.weights[index] if subset_weights is None else subset_weights
        if subset is not None and subset_weights is None:
            weights = weights * (self.weights.sum() / weights.sum())
        chunks = zip(torch.split(index, self.chunk_size), torch.split(weights, self.chunk_size), strict=True)
        terms: list[Term] = [
            lambda params, rows=rows, weight=weight: self.losses(params, rows) @ weight
            for rows, weight in chunks
        ]
        anchor = self.anchor
        if self.proximal > 0.0 and anchor is not None:
            terms.append(lambda params: proximal_loss(params, anchor, self.proximal))
        return terms


def hypergradient(
    inner: InnerProblem,
    validation: Sequence[Term],
    estimates: Mapping[str, Estimate],
    solver: AdjointSolver,
    generator: torch.Generator,
    previous: Float[Tensor, "m"] | None = None,
) -> Hypergradient[ImplicitAdjoint]:
    """Compute Eq. 2 for every object.

    Args:
        inner: the inner problem at its minimiser.
        validation: the terms of L_val as functions of the parameters.
        estimates: by object, the function from v to ``d/dpsi <dL_train/dtheta, v>``.
        solver: solves for v. If it fails, its best iterate is used: check ``adjoint.solution.status``.
        generator: source of the damping's random start vector, if it needs one.
        previous: initial guess of v, used if the choice of the damping gives none.
    """
    began = time.perf_counter()
    right_hand_side = gradient(validation, inner.params)
    stationarity = norm(gradient(inner.terms(), inner.params))
    validated = time.perf_counter()
    adjoint: Adjoint = solver.solve(
        inner.terms(inner.subset, inner.subset_weights), inner.params, right_hand_side, previous, generator
    )
    solved = time.perf_counter()
    vector = unflatten(adjoint.vector, inner.params)
    mixed = {name: estimate(vector) for name, estimate in estimates.items()}
    seconds = {
        "validation": validated - began,
        "solve": solved - validated,
        "mixed": time.perf_counter() - solved,
    }
    return Hypergradient(
        # The only minus sign of the implicit function theorem: dtheta/dpsi = -(H + lambda I)^-1 d2L_train/dtheta dpsi.
        gradients={name: -part.value for name, part in mixed.items()},
        errors={name: part.standard_error for name, part in mixed.items()},
        p_values={name: part.p_values for name, part in mixed.items()},
        seconds=seconds,
        adjoint=ImplicitAdjoint(
            adjoint.solution, adjoint.damping, adjoint.damping_raises, stationarity, norm(right_hand_side)
        ),
    )


def curvature_rows(
    drawn: int, weights: Float[Tensor, "N"], wanted: int, generator: torch.Generator
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Choose the rows of the training set that Hessian products use, and weight them.

    About ``wanted`` rows are chosen at random (0: all). The first ``drawn`` rows were drawn from p_psi, the others are
    photographs. Each of the two parts gets rows in proportion to its total weight, which they share equally.
    """
    count = len(weights)
    if not 0 < wanted < count:
        return torch.arange(count), weights
    rows: list[Tensor] = []
    scaled: list[Tensor] = []
    for first, last in ((0, drawn), (drawn, count)):
        size, mass = last - first, float(weights[first:last].sum())
        if size == 0:
            continue
        few = min(size, max(1, round(wanted * mass))) if size < count else wanted
        rows.append(first + torch.randperm(size, generator=generator)[:few])
        scaled.append(torch.full((few,), mass / few))
    return torch.cat(rows), torch.cat(scaled)
