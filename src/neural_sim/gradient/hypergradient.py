"""The hypergradient, by either adjoint.

Implicit (Eq. 2): ``dL_val/dpsi = - d/dpsi <dL_train/dtheta, v>`` with ``(H + lambda I) v = dL_val/dtheta``. Unrolled:
the derivative of the training that was run, :mod:`gradient.unrolled`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.detector.losses import proximal_loss
from neural_sim.detector.trajectory import Trajectory
from neural_sim.gradient.accumulated import Accumulated, ProbeGroups, Unrolled
from neural_sim.gradient.base import IndexedLoss, MixedDerivative, Params
from neural_sim.gradient.unrolled import Examples, Wanted
from neural_sim.solver.adjoint import Adjoint, AdjointSolver
from neural_sim.solver.base import Solution, Status
from neural_sim.solver.damping import Damped
from neural_sim.solver.hvp import Term, gradient
from neural_sim.solver.operator import norm, unflatten

Estimate = Callable[[Params], MixedDerivative]
UnrolledEstimate = Callable[[Accumulated], MixedDerivative]


@dataclass(frozen=True)
class InnerProblem:
    """``L_train(theta) = sum_i w_i l_i(theta) + proximal / 2 |theta - anchor|^2`` at its (near) minimiser
    ``params``.

    ``weights`` [N] are those of rows 0..N-1 of ``losses``; 1 / N each for independent draws. At most ``chunk_size``
    images are in memory at a time. ``anchor`` is the fixed theta_0 of the proximal term: with it ``(H + proximal
    I)^-1`` is the problem's exact derivative. ``subset`` limits Hessian products (not the stationarity) to these rows,
    of ``subset_weights``; None: of their own weights, scaled up to the same sum.
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
        """The loss as a sum over chunks (and the proximal term), of all rows or of a subset that stands for them, see
        ``subset``.
        """
        index = torch.arange(self.weights.numel(), device=self.weights.device) if subset is None else subset
        weights = self.weights[index] if subset_weights is None else subset_weights
        if subset is not None and subset_weights is None:
            weights = weights * (self.weights.sum() / weights.sum())
        chunks = zip(index.split(self.chunk_size), weights.split(self.chunk_size), strict=True)
        terms: list[Term] = [
            lambda params, rows=rows, weight=weight: self.losses(params, rows) @ weight
            for rows, weight in chunks
        ]
        anchor = self.anchor
        if self.proximal > 0.0 and anchor is not None:
            terms.append(lambda params: proximal_loss(params, anchor, self.proximal))
        return terms


@dataclass(frozen=True)
class Hypergradient:
    """``dL_val/dpsi`` per object with everything needed to judge it.

    ``stationarity`` is ``|dL_train/dtheta|``, 0 at a minimiser, which the implicit function theorem assumes; nan where
    training was unrolled, which assumes none.
    ``sensitivity`` is ``|g(2 lambda) - g(lambda)| / |g(lambda)|`` of the psi gradients g of all objects together, nan
    unless the solver was asked for it. Not a bias: an indefinite H has poles in lambda.
    ``p_values`` by object and factor, see :class:`MixedDerivative`. ``seconds`` by phase: validation, solve (or
    unrolled), mixed. ``damping_raises`` counts the increases of lambda. Where training was unrolled, ``solution`` has
    status UNROLLED, the reversed steps as steps and products, and ``dL_val/dtheta`` as value; there is no damping.
    """

    psi_gradients: dict[str, Float[Tensor, "k"]]
    standard_errors: dict[str, Float[Tensor, "k"]]
    p_values: dict[str, Mapping[str, float]]
    solution: Solution
    damping: Damped
    sensitivity: float
    stationarity: float
    validation_norm: float
    seconds: dict[str, float] = field(default_factory=dict)
    damping_raises: int = 0


def hypergradient(
    inner: InnerProblem,
    validation: Sequence[Term],
    estimates: Mapping[str, Estimate],
    solver: AdjointSolver,
    generator: torch.Generator,
    previous: Float[Tensor, "m"] | None = None,
) -> Hypergradient:
    """Eq. 2 for every object.

    ``validation`` are the terms of L_val as functions of the parameters. ``estimates`` maps an object's name
    to a function from v to ``d/dpsi <dL_train/dtheta, v>``.
    ``previous`` is the solve's initial guess. A failed solve returns the best iterate: read ``solution.status``.
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
    sensitivity = math.nan
    if adjoint.doubled is not None and mixed:
        doubled = unflatten(adjoint.doubled, inner.params)
        sensitivity = _relative_change(
            mixed, {name: estimate(doubled) for name, estimate in estimates.items()}
        )
    seconds = {
        "validation": validated - began,
        "solve": solved - validated,
        "mixed": time.perf_counter() - solved,
    }
    return Hypergradient(
        # The one minus sign of the implicit function theorem: dtheta/dpsi = -(H + lambda I)^-1 d2L_train/dtheta dpsi.
        psi_gradients={name: -part.value for name, part in mixed.items()},
        standard_errors={name: part.standard_error for name, part in mixed.items()},
        p_values={name: part.p_values for name, part in mixed.items()},
        solution=adjoint.solution,
        damping=adjoint.damping,
        sensitivity=sensitivity,
        stationarity=stationarity,
        validation_norm=norm(right_hand_side),
        seconds=seconds,
        damping_raises=adjoint.damping_raises,
    )


def unrolled_hypergradient(
    inner: InnerProblem,
    trajectory: Trajectory,
    examples: Examples,
    validation: Sequence[Term],
    estimates: Mapping[str, UnrolledEstimate],
    unrolled: Unrolled,
    generator: torch.Generator,
    probes: ProbeGroups | None = None,
    wanted: Wanted = "weights",
) -> Hypergradient:
    """The derivative of the training that was run, for every object.

    ``trajectory`` is that training, of ``examples``, which ended at ``inner.params``. ``estimates`` maps an object's
    name to its estimator as a function of the sums over the steps. ``probes`` and ``wanted`` say what is summed.
    """
    began = time.perf_counter()
    slope = gradient(validation, inner.params)
    validated = time.perf_counter()
    sums = unrolled.accumulate(trajectory, examples, inner.params, slope, generator, probes, wanted)
    walked = time.perf_counter()
    parts = {name: estimate(sums) for name, estimate in estimates.items()}
    steps = len(trajectory) - trajectory.first
    finite = bool(sums.images.isfinite().all() and sums.probes.isfinite().all())
    solution = Solution(
        slope, Status.UNROLLED if finite else Status.NON_FINITE, steps, 0.0, (0.0, 0.0), steps, False
    )
    return Hypergradient(
        psi_gradients={name: part.value for name, part in parts.items()},
        standard_errors={name: part.standard_error for name, part in parts.items()},
        p_values={name: part.p_values for name, part in parts.items()},
        solution=solution,
        damping=Damped(0.0, None),
        sensitivity=math.nan,
        stationarity=math.nan,
        validation_norm=norm(slope),
        seconds={
            "validation": validated - began,
            "unrolled": walked - validated,
            "mixed": time.perf_counter() - walked,
        },
    )


def _relative_change(before: Mapping[str, MixedDerivative], after: Mapping[str, MixedDerivative]) -> float:
    old = torch.cat([part.value for part in before.values()])
    new = torch.cat([part.value for part in after.values()])
    size = norm(old)
    return norm(new - old) / size if size > 0.0 else math.nan
