"""``outer/first_step``: proposes the psi that a loop tries first."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.label_shift.estimate import Groups, estimate
from neural_sim.baseline.label_shift.evidence import MOVING, FactorEstimate
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.outer.steps import Proposal
from neural_sim.parameter.distributions import total_variation
from neural_sim.ranges import validated
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages

AT_GUESS = 0.05
"""Total variation between psi and a guess up to which the guess is not worth a training."""


@validated
@dataclass(frozen=True)
class Derivative:
    """``outer.first_step``: propose nothing; the first step follows the first derivative."""


class FirstStep(Protocol):
    """Proposes a psi before the first derivative; a training accepts or rejects it, object by object."""

    def propose(
        self,
        scene: Scene,
        images: LabelledImages,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
    ) -> Proposal:
        """Propose a psi.

        Args:
            scene: draws images of all bins, without rendering if the loop has a pool.
            images: labelled images of the target.
            psi: the loop's present psi.
            generator: the source of all random numbers.
        """
        ...


@dataclass(frozen=True)
class WhatTheTargetShows(FirstStep):
    """Proposes the psi that is estimated from the target's boxes.

    Attributes:
        settings: settings of the estimate.
        groups: bins that look the same.
        whole: use whole images instead of boxes, for classification.
    """

    settings: LabelShift
    groups: Groups = field(default_factory=dict)
    whole: bool = False

    @override
    def propose(
        self,
        scene: Scene,
        images: LabelledImages,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
    ) -> Proposal:
        found = estimate(scene, images, psi, self.settings, generator, self.groups, self.whole)
        p_values = torch.tensor(
            [p_value_of(found.factors, name) for name in scene.names], dtype=torch.float64
        )
        return Proposal(found.psi, p_values, found.images, found.factors)


def with_guesses(proposal: Proposal, names: Collection[str], scene: Scene) -> Proposal:
    """Propose guesses for those factors of the named objects that were not read, and mark them as ``guessed``.

    This is for objects that the detector does not find at the present psi, where derivatives are weak. Bins become
    uniform: trained on all of them, the detector finds the object in some. An object has only one light at a time, so
    for lights the guess is the estimate, although it was too uncertain to be believed. Objects that the proposal moves,
    and factors that may be right already, stay as proposed.
    """
    distribution = scene.distribution
    psi, p_values = proposal.psi.clone(), proposal.p_values.clone()
    parts, even = (distribution.split(each) for each in (psi, distribution.uniform_of(scene.names).to(psi)))
    moved = {one.name for one in proposal.shown if one.finding in MOVING}
    shown = list(proposal.shown)
    for i, one in enumerate(shown):
        if one.name not in names or one.name in moved or one.finding == "stays":
            continue
        label, factor = scene.names.index(one.name), distribution.factor(one.factor)
        guess = even[one.factor][label]
        if one.lights:
            guess = factor.project(factor.psi_of(torch.tensor(one.p).to(psi)))
        now = parts[one.factor][label]  # a view of psi
        if float(total_variation(factor.p_of(now), factor.p_of(guess))) > AT_GUESS:
            now.copy_(guess)
            p_values[label] = 0.5  # no evidence for it: the training alone decides
            shown[i] = replace(one, guessed=True)
    return replace(proposal, psi=psi, p_values=p_values, shown=tuple(shown))


def p_value_of(factors: Sequence[FactorEstimate], name: str) -> float:
    """Compute the p-value of the null hypothesis that an object's present psi is right.

    If several factors move, the most significant one counts, with its p-value times their number (Bonferroni).
    """
    moving = [one.p_value for one in factors if one.name == name and one.finding in MOVING]
    return min(1.0, len(moving) * min(moving)) if moving else 1.0


def read_objects(factors: Sequence[FactorEstimate]) -> set[str]:
    """Return the names of the objects with a final estimate of every factor, whether or not psi moves there."""
    unread = {one.name for one in factors if one.finding not in ("moves", "stays")}
    return {one.name for one in factors} - unread
