"""Steps of psi: the common protocol, and free gradient steps. For trust-region steps see ``outer.trust_region``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate
from neural_sim.parameter.factor import Factor
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import Mirror, Update, UpdateState
from neural_sim.ranges import PositiveFraction, validated

PValues = Mapping[str, Mapping[str, float]]
"""P-values by object and factor."""


@dataclass(frozen=True)
class Verdict:
    """Whether a training at the new psi accepted an object's step; a rejected step is undone.

    ``expected_gain`` is the fall of L_val that the hypergradient predicts to first order, ``measured_gain`` the rise of
    the object's score, ``error`` the standard error of that rise over validation images and trainings.
    """

    accepted: bool
    expected_gain: float
    measured_gain: float
    error: float


@dataclass(frozen=True)
class Proposal:
    """A psi for all objects, proposed without a derivative.

    Attributes:
        psi: the proposed psi; for an object that should stay, its present one.
        p_values: p-values, by object, of the null hypothesis that the present psi is right.
        images: number of images that the proposal took.
        shown: the estimate from the target's boxes on which psi is based.
    """

    psi: Float[Tensor, "objects K"]
    p_values: Float[Tensor, "objects"]
    images: int = 0
    shown: tuple[FactorEstimate, ...] = ()


@dataclass(frozen=True)
class LearnedObjects:
    """The objects whose psi moves, by name and class, and p_psi."""

    names: Sequence[str]
    labels: Sequence[int]
    distribution: SceneDistribution


class Steps(Protocol):
    """Present psi [objects, K] of the learned objects, and the evidence for the next step.

    It is immutable: ``judge``, ``observe`` and ``propose``, called in this order, each return a new state.
    """

    @property
    def reported(self) -> Float[Tensor, "objects K"]:
        """The psi that the loop would return if it ended now."""
        ...

    @property
    def pending(self) -> bool:
        """Whether the last step waits for ``judge``."""
        ...

    @property
    def waiting(self) -> Collection[tuple[str, str]]:
        """Pairs of object and factor that the last step did not move."""
        ...

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> tuple[Self, dict[str, Verdict]]:
        """Accept or reject the pending step by the scores of trainings ``before`` and ``after`` it.

        The scores are each validation image's contributions to the score of each class; higher is better.
        """
        ...

    def observe(self, result: Hypergradient) -> tuple[Self, PValues]:
        """Add a derivative at ``reported``.

        The p-values test the null hypothesis that the derivative along which steps go is zero.
        """
        ...

    def propose(self, certificate: Certificate, shrink: float) -> Self:
        """Take the next step; of a shrunk step, only the fraction ``shrink`` is taken."""
        ...


@validated
@dataclass(frozen=True)
class FreeSteps:
    """``outer.steps``: gradient steps that are never rejected.

    Args:
        update: optimiser of the bins' logits.
        light_update: optimiser of the weights of lights, which are then projected onto their constraint.
        final_step: factor on the last step; on earlier ones, it falls linearly from 1 (Robbins and Monro 1951).
    """

    trainings: ClassVar[int] = 1
    folds: ClassVar[int] = 1

    update: Update = field(default_factory=lambda: Mirror(learning_rate=3.0, max_step=3.0))
    light_update: Update = field(default_factory=lambda: Mirror(learning_rate=0.6, max_step=1.0))
    final_step: PositiveFraction = 0.1

    def begin(
        self, objects: LearnedObjects, psi: Float[Tensor, "objects K"], iterations: int
    ) -> GradientSteps:
        """Start at ``psi``, before the first of ``iterations`` steps."""
        psi = psi.detach().clone()
        states = {name: UpdateState.zeros(part) for name, part in objects.distribution.split(psi).items()}
        nothing = torch.zeros_like(psi)
        return GradientSteps(self, objects, iterations, psi, states, nothing, nothing)


@dataclass(frozen=True)
class GradientSteps:
    """State of psi under free steps.

    Attributes:
        settings: settings of the steps.
        objects: the learned objects.
        iterations: number of iterations over which steps shorten.
        reported: psi.
        updates: states of the optimisers, by factor.
        gradient: the derivative observed last.
        error: its standard errors.
        taken: number of steps taken.
    """

    settings: FreeSteps
    objects: LearnedObjects
    iterations: int
    reported: Float[Tensor, "objects K"]
    updates: Mapping[str, UpdateState]
    gradient: Float[Tensor, "objects K"]
    error: Float[Tensor, "objects K"]
    taken: int = 0

    @property
    def pending(self) -> bool:
        """False: no step is judged."""
        return False

    @property
    def waiting(self) -> Collection[tuple[str, str]]:
        """Empty: no object waits."""
        return ()

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> tuple[GradientSteps, dict[str, Verdict]]:
        """Accept every step."""
        return self, {}

    def observe(self, result: Hypergradient) -> tuple[GradientSteps, PValues]:
        """Keep only the last derivative; see ``Steps``."""
        gradient, error = stacked(result, self.objects.names, self.reported)
        return replace(self, gradient=gradient, error=error), result.p_values

    def propose(self, certificate: Certificate, shrink: float) -> GradientSteps:
        """Take the optimisers' steps; see ``Steps``.

        An insignificant derivative still enters the momentum: the average of several may be significant.
        """
        length = 1.0 + self.taken / max(1, self.iterations - 1) * (self.settings.final_step - 1.0)
        if certificate.void:
            return replace(self, taken=self.taken + 1)
        distribution, updates, moved = self.objects.distribution, dict(self.updates), {}
        psi, slope, noise = (
            distribution.split(values) for values in (self.reported, self.gradient, self.error)
        )
        for factor in distribution.factors:
            name = factor.name
            after, updates[name] = self._step(factor, psi[name], slope[name], noise[name])
            part = after.new_tensor(fractions(certificate, self.objects.names, name, shrink))
            moved[name] = psi[name] + part[:, None] * (after - psi[name])
        reported = self.reported + length * (distribution.join(moved) - self.reported)
        return replace(self, reported=reported, updates=updates, taken=self.taken + 1)

    def _step(self, factor: Factor, psi: Tensor, slope: Tensor, noise: Tensor) -> tuple[Tensor, UpdateState]:
        """Step along one factor, in logits of bins or weights of lights, and project the result onto its constraint."""
        update: Update = getattr(self.settings, factor.update)
        state = self.updates[factor.name]
        moved, state = update.step(psi, factor.log_slopes(psi), slope, noise, state)
        return factor.project(moved), state


def fractions(certificate: Certificate, names: Sequence[str], factor: str, shrink: float) -> list[float]:
    """Return the fraction of each object's step along a factor that is taken; ``shrink`` for shrunk steps."""
    taken = {"kept": 1.0, "taken": 1.0, "shrunk": shrink, "skipped": 0.0}
    return [taken[certificate.actions[name][factor]] for name in names]


def slopes_by_p(
    factor: Factor,
    psi: Float[Tensor, "objects k"],
    gradient: Float[Tensor, "objects k"],
    error: Float[Tensor, "objects k"],
) -> tuple[Float[Tensor, "objects k"], Float[Tensor, "objects k"]]:
    """Convert the derivative of L_val by psi to the derivative of minus L_val by a factor's p, centred.

    The derivative with respect to logits is (p - floor) times the one by p (up to a constant), so that steps along it
    would hardly move a bin of small p. ``error`` has the standard errors of ``gradient``; the second result has the
    variances of the first. Both are 0 in closed bins, which have no derivative with respect to p.
    """
    scale = factor.log_slopes(psi).exp()
    open_ = scale > 0.0
    direction = torch.where(open_, -gradient / scale, 0.0)
    centre = direction.sum(-1, keepdim=True) / open_.sum(-1, keepdim=True)
    return torch.where(open_, direction - centre, 0.0), torch.where(open_, (error / scale).square(), 0.0)


def stacked(
    result: Hypergradient, names: Sequence[str], like: Tensor
) -> tuple[Float[Tensor, "objects K"], Float[Tensor, "objects K"]]:
    """Stack the named objects' derivatives, and their standard errors, as rows."""
    both = (result.gradients, result.errors)
    gradient, error = (torch.stack([values[name] for name in names]).to(like) for values in both)
    return gradient, error
