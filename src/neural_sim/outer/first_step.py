"""``outer/first_step``: proposes the psi that a loop tries first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.label_shift.estimate import Groups, estimate
from neural_sim.baseline.label_shift.evidence import MOVING, FactorEstimate
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.outer.steps import Proposal
from neural_sim.ranges import validated
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages


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
