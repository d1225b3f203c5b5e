"""Settings of the estimate by label shift, which is a method of its own and the psi loop's first step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Lt

from neural_sim.baseline.label_shift.crops import Augmentation
from neural_sim.baseline.label_shift.network import Fitting
from neural_sim.ranges import Fraction, NonNegative, PositiveFraction, PositiveInt, validated


@validated
@dataclass(frozen=True)
class LabelShift:
    """How psi is read off the target.

    Args:
        per_bin: renders of every bin and object, where the scene has no pool of them yet.
        held_out: part of the renders that calibrates and tests instead of training.
        compositions: images that each render is in on average, over other backgrounds.
        backgrounds: that these images share.
        fitting: how the classifier is trained.
        augmentation: changes of its crops.
        prior: boxes that the Dirichlet prior adds to every bin.
        level: of the test against where psi stands; that part of the objects at their target moves by chance.
        draws: of the test's bootstrap and of the intervals.
        interval: probability that an interval covers.
        strange: largest probability that a box may look less like the renders than a held-out render does; above, its
            object's psi does not move.
        doubt: largest total variation that is expected between an estimate and the target's distribution; above, psi
            does not move.
        skill: smallest accuracy on held-out renders, from 0 of chance to 1; below, psi does not move.
        fewest: boxes of an object, below which it does not move.
        name: in reports.
    """

    per_bin: PositiveInt = 48
    held_out: Annotated[float, Gt(0), Lt(1)] = 0.25
    compositions: Annotated[int, Ge(1)] = 1
    backgrounds: PositiveInt = 256
    fitting: Fitting = field(default_factory=Fitting)
    augmentation: Augmentation = field(default_factory=Augmentation)
    prior: NonNegative = 0.3
    level: PositiveFraction = 0.05
    draws: Annotated[int, Ge(19)] = 199
    interval: Annotated[float, Gt(0), Lt(1)] = 0.9
    strange: PositiveFraction = 0.7
    doubt: Fraction = 0.35
    skill: Fraction = 0.15
    fewest: PositiveInt = 8
    name: str = "label_shift"
