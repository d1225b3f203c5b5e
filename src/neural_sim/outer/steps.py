"""Steps of psi: what every kind has, and free steps. Trust-region steps: :mod:`outer.checked`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import Certificate
from neural_sim.outer.settings import Outer
from neural_sim.parameter.factor import Factor
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import Update, UpdateState

PValues = Mapping[str, Mapping[str, float]]
"""By object and factor."""


@dataclass(frozen=True)
class Verdict:
    """Whether an object's step was accepted, by a training at the new psi; a rejected one is taken back.

    ``expected_gain`` is the fall of L_val that the hypergradient predicts to first order, ``measured_gain`` the rise of
    the object's score, ``error`` the standard error of that rise, over validation images and trainings.
    """

    accepted: bool
    expected_gain: float
    measured_gain: float
    error: float


class Steps(Protocol):
    """Moves psi [objects, K] of the learned objects."""

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> dict[str, Verdict]:
        """Accept or reject the last step by trainings before and after it. The scores are each validation image's
        contributions to the score of each class, more is better.
        """
        ...

    def observe(self, result: Hypergradient) -> PValues:
        """Add a derivative at ``reported``, after :meth:`judge` where a step was pending; p-values of the null that the
        derivative which steps follow is zero.
        """
        ...

    def next(self, certificate: Certificate) -> Float[Tensor, "objects K"]:
        """Psi after the next step."""
        ...

    @property
    def waiting(self) -> Collection[tuple[str, str]]:
        """Objects and factors that the last step did not move, whatever the certificate allowed."""
        ...

    @property
    def pending(self) -> bool:
        """Whether the last step waits for :meth:`judge`."""
        ...

    @property
    def reported(self) -> Float[Tensor, "objects K"]:
        """Psi of the loop's result if it ends now."""
        ...


class FreeSteps:
    """Steps of ``outer.update`` and ``outer.light_update``, none of which is rejected.

    Steps shorten linearly over ``outer.iterations`` to ``outer.final_step`` of their length.
    """

    def __init__(
        self,
        settings: Outer,
        distribution: SceneDistribution,
        names: Sequence[str],
        psi: Float[Tensor, "objects K"],
    ) -> None:
        self.settings, self.distribution, self.names = settings, distribution, names
        self.reported = psi.detach().clone()
        self._states = {name: UpdateState.zeros(part) for name, part in distribution.split(psi).items()}
        self._gradient = self._error = torch.zeros_like(psi)
        self._steps, self.pending = 0, False

    waiting: Collection[tuple[str, str]] = ()

    def judge(
        self, before: Float[Tensor, "classes images"], after: Float[Tensor, "classes images"]
    ) -> dict[str, Verdict]:
        return {}

    def observe(self, result: Hypergradient) -> PValues:
        self._gradient, self._error = stacked(result, self.names, self.reported)
        return result.p_values

    def next(self, certificate: Certificate) -> Float[Tensor, "objects K"]:
        """An insignificant derivative enters the momentum nevertheless: the average of several may be significant."""
        length = 1.0 + self._steps / max(1, self.settings.iterations - 1) * (self.settings.final_step - 1.0)
        self._steps += 1
        if certificate.void:
            return self.reported
        psi, slope, noise = (
            self.distribution.split(values) for values in (self.reported, self._gradient, self._error)
        )
        moved = {}
        for factor in self.distribution.factors:
            name = factor.name
            after = self._step(factor, psi[name], slope[name], noise[name])
            taken = after.new_tensor(fractions(certificate, self.names, name, self.settings.trust.shrink))
            moved[name] = psi[name] + taken[:, None] * (after - psi[name])
        self.reported = self.reported + length * (self.distribution.join(moved) - self.reported)
        return self.reported

    def _step(self, factor: Factor, psi: Tensor, slope: Tensor, noise: Tensor) -> Tensor:
        """One factor's step in logits of bins, or in weights of lights, which are projected on their constraint."""
        update: Update = getattr(self.settings, factor.update)
        moved, self._states[factor.name] = update.step(
            psi, factor.log_slopes(psi), slope, noise, self._states[factor.name]
        )
        return factor.project(moved)


def fractions(certificate: Certificate, names: Sequence[str], factor: str, shrink: float) -> list[float]:
    """Fraction that is taken of each object's step by a factor; ``shrink`` is that of a shrunk step."""
    taken = {"kept": 1.0, "shrunk": shrink, "skipped": 0.0, "stopped": 0.0}
    return [taken[certificate.actions[name][factor]] for name in names]


def by_p(
    factor: Factor,
    psi: Float[Tensor, "objects k"],
    gradient: Float[Tensor, "objects k"],
    error: Float[Tensor, "objects k"],
) -> tuple[Float[Tensor, "objects k"], Float[Tensor, "objects k"]]:
    """The derivative of minus L_val by a factor's p, centred, and its components' variances.

    ``gradient`` and ``error`` are the derivative of L_val by psi and its standard errors. By logits it is p - floor
    times that by p, and would hardly move a bin of small p.
    """
    scale = factor.log_slopes(psi).exp()
    direction = -gradient / scale
    return direction - direction.mean(-1, keepdim=True), (error / scale).square()


def stacked(
    result: Hypergradient, names: Sequence[str], like: Tensor
) -> tuple[Float[Tensor, "objects K"], Float[Tensor, "objects K"]]:
    """The named objects' derivatives and their standard errors."""
    both = (result.psi_gradients, result.standard_errors)
    gradient, error = (torch.stack([values[name] for name in names]).to(like) for values in both)
    return gradient, error
