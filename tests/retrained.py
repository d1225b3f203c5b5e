"""The hypergradient by finite differences of a retrained inner problem: the reference of the implicit one.

The problem is small enough to be trained to a stationary point. It has a fixed sample of every bin, and psi enters by
the bins' weights alone, so that its minimiser is a smooth and deterministic function of psi.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from newton import Minimum, minimise
from torch import Tensor

from neural_sim.gradient.base import IndexedLoss, MixedDerivative, Params, Probes
from neural_sim.gradient.estimators import importance_weights
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.gradient.mixed import scores
from neural_sim.solver.hvp import Term

STEP = 0.05  # logits
TOLERANCE = 1e-7  # of a retraining's gradient norm


@dataclass(frozen=True)
class BinnedProblem:
    """``L_train(theta, psi) = 1/objects sum_o sum_b p_b(psi_o) mean_b l(theta) + proximal/2 |theta - anchor|^2``.

    ``probes`` are the rows and bins of every object's images among those of ``losses``; ``log_probabilities`` maps
    logits to log p over the bins.
    """

    losses: IndexedLoss
    probes: Sequence[Probes]
    log_probabilities: Callable[[Float[Tensor, "k"]], Float[Tensor, "k"]]
    proximal: float
    anchor: Params
    chunk_size: int = 64

    def weights(self, psi: Float[Tensor, "objects k"]) -> Float[Tensor, "n"]:
        """The images' weights in L_train."""
        weights = psi.new_zeros(sum(len(part.index) for part in self.probes))
        for logits, part in zip(psi, self.probes, strict=True):
            p = self.log_probabilities(logits).exp()
            weights[part.index] = importance_weights(p, part.bins, 1.0 / len(self.probes))
        return weights

    def at(self, psi: Float[Tensor, "objects k"], params: Params) -> InnerProblem:
        """The inner problem of these logits, at the parameters ``params``."""
        anchor = self.anchor if self.proximal > 0.0 else None
        weights = self.weights(psi).to(next(iter(params.values())).device)
        return InnerProblem(params, self.losses, weights, self.chunk_size, self.proximal, anchor)

    def retrain(self, psi: Float[Tensor, "objects k"], start: Params, tolerance: float) -> Minimum:
        """The minimiser reached from ``start``, of a gradient norm of at most ``tolerance`` if it converged."""
        return minimise(self.at(psi, start).terms(), start, tolerance)

    def estimate(
        self, psi: Float[Tensor, "objects k"], label: int, params: Params
    ) -> Callable[[Params], MixedDerivative]:
        """``v -> d/dpsi <dL_train/dtheta, v>`` of one object; exact, without sampling."""
        part = self.probes[label]

        def exact(vector: Params) -> MixedDerivative:
            along = scores(self.losses, params, vector, part.index, self.chunk_size).to(psi)
            leaf = psi[label].detach().requires_grad_()
            with torch.enable_grad():
                p = self.log_probabilities(leaf).exp()
                total = importance_weights(p, part.bins, 1.0 / len(self.probes)) @ along
            value = torch.autograd.grad(total, leaf)[0]
            return MixedDerivative(value, torch.zeros_like(value))

        return exact


@dataclass(frozen=True)
class FiniteDifference:
    """Central differences of L_val at retrained parameters, in centred logits of one object.

    ``slope`` is the largest final gradient norm of the retrainings; ``converged`` says whether all of them reached the
    tolerance. ``trainings`` counts the retrainings.
    """

    gradient: Float[Tensor, "k"]
    converged: bool
    slope: float
    trainings: int


def finite_difference(
    problem: BinnedProblem,
    validation: Sequence[Term],
    psi: Float[Tensor, "objects k"],
    label: int,
    start: Params,
    step: float = STEP,
    tolerance: float = TOLERANCE,
) -> FiniteDifference:
    """dL_val/dpsi of object ``label`` by k - 1 central differences of ``step`` logits, two retrainings each.

    Every retraining starts from ``start``, the minimiser at ``psi``. Error: ``step``^2 / 6 times a third derivative,
    and ``|dL_val/dtheta| tolerance / (proximal step)`` from ending the retrainings at ``tolerance``.
    """
    total, runs = torch.zeros_like(psi[label]), []
    for direction in contrasts(psi.shape[-1]).to(psi):
        values = []
        for sign in (1.0, -1.0):
            moved = psi.clone()
            moved[label] += sign * step * direction
            runs.append(problem.retrain(moved, start, tolerance))
            with torch.no_grad():
                values.append(math.fsum(float(term(runs[-1].params)) for term in validation))
        total += (values[0] - values[1]) / (2.0 * step) * direction
    return FiniteDifference(
        total, all(run.converged for run in runs), max(run.slope for run in runs), len(runs)
    )


def contrasts(k: int) -> Float[Tensor, "k-1 k"]:
    """Orthonormal rows that sum to zero (Helmert's): a basis of centred logits."""
    rows = torch.zeros(k - 1, k, dtype=torch.float64)
    for i in range(1, k):
        rows[i - 1, :i], rows[i - 1, i] = 1.0, -float(i)
    return rows / rows.norm(dim=-1, keepdim=True)
