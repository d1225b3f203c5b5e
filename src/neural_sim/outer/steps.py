"""What an iteration's hypergradient does to psi: steps taken as they come. Checked ones: :mod:`outer.checked`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
PARTS = {"kept": 1.0, "skipped": 0.0, "stopped": 0.0}
"""What is left of a step by what its certificate did; of one that is shrunk, ``outer.trust.shrink``."""


@dataclass(frozen=True)
class Verdict:
    """What became of an object's step, seen from the next iteration's training.

    ``promised`` is the fall of L_val that the hypergradient foretold to first order, ``came`` the rise of the object's
    own score, ``error`` the standard error of that rise by validation image. A step that was not ``accepted`` was
    undone.
    """

    accepted: bool
    promised: float
    came: float
    error: float


class Steps(Protocol):
    """Moves psi [objects, K] of the objects that are learned."""

    def judge(self, scores: Float[Tensor, "classes images"]) -> dict[str, Verdict]:
        """What the training on the last step's psi says of it. ``scores`` are what each validation image adds to the
        score of each class, more is better."""
        ...

    def observe(self, result: Hypergradient) -> PValues:
        """Take in an iteration's derivative; p-values of the null that the derivative which steps follow is zero."""
        ...

    def next(self, certificate: Certificate) -> Float[Tensor, "objects K"]:
        """psi that the next iteration trains on."""
        ...

    @property
    def moved(self) -> bool:
        """Whether the last :meth:`next` moved psi."""
        ...

    @property
    def reported(self) -> Float[Tensor, "objects K"]:
        """psi that the loop reports if it ends now."""
        ...


class FreeSteps:
    """``outer.update`` and ``outer.light_update``, step by step, with nothing undone.

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
        self._done, self.moved = 0, True

    def judge(self, scores: Float[Tensor, "classes images"]) -> dict[str, Verdict]:
        return {}

    def observe(self, result: Hypergradient) -> PValues:
        self._gradient, self._error = stacked(result, self.names, self.reported)
        return result.p_values

    def next(self, certificate: Certificate) -> Float[Tensor, "objects K"]:
        """A derivative without signal joins the momentum nevertheless: the average of several may tell what each does
        not."""
        part = 1.0 + self._done / max(1, self.settings.iterations - 1) * (self.settings.final_step - 1.0)
        self._done += 1
        if certificate.void:
            return self.reported
        psi, slope, noise = (
            self.distribution.split(values) for values in (self.reported, self._gradient, self._error)
        )
        moved, parts = {}, {**PARTS, "shrunk": self.settings.trust.shrink}
        for factor in self.distribution.factors:
            name = factor.name
            after = self._step(factor, psi[name], slope[name], noise[name])
            left = [parts[certificate.actions[object_name][name]] for object_name in self.names]
            moved[name] = psi[name] + after.new_tensor(left)[:, None] * (after - psi[name])
        self.reported = self.reported + part * (self.distribution.join(moved) - self.reported)
        return self.reported

    def _step(self, factor: Factor, psi: Tensor, slope: Tensor, noise: Tensor) -> Tensor:
        """One factor's step: in logits of bins, or in weights of lights, which stay on their constraint."""
        update: Update = getattr(self.settings, factor.update)
        moved, self._states[factor.name] = update.step(
            psi, factor.log_probabilities(psi), slope, noise, self._states[factor.name]
        )
        return factor.project(moved)


def stacked(
    result: Hypergradient, names: Sequence[str], like: Tensor
) -> tuple[Float[Tensor, "objects K"], Float[Tensor, "objects K"]]:
    """The named objects' derivatives and their standard errors."""
    found = (result.psi_gradients, result.standard_errors)
    gradient, error = (torch.stack([values[name] for name in names]).to(like) for values in found)
    return gradient, error
