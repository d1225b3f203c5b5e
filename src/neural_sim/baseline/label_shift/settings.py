"""Settings of the label-shift estimate, which is a method of its own or the psi loop's first step."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from annotated_types import Ge, Gt, Lt

from neural_sim.baseline.label_shift.crops import ANY_ROLL_DEG, RENDERED_ROLL_DEG, Augmentation
from neural_sim.baseline.label_shift.network import Fitting
from neural_sim.ranges import Fraction, NonNegative, PositiveFraction, PositiveInt, validated


@validated
@dataclass(frozen=True)
class LabelShift:
    """How psi is estimated from the target.

    Args:
        per_bin: smallest number of renders of every bin of each object, if the scene has no pool of them yet.
        held_out: fraction of the renders that is held out from training, for calibration and tests.
        compositions: number of images drawn per render; the same render appears on different backgrounds.
        backgrounds: number of different backgrounds, from which each image gets one at random.
        fitting: how the classifier is trained.
        augmentation: random changes of the crops on which it is trained.
        prior: number of boxes that the Dirichlet prior adds to every bin.
        level: significance level of the test of whether the target differs from the present psi, that is, the fraction
            of objects already at their target that move by chance.
        draws: number of draws for the bootstrap of the test and, for lights, for the intervals.
        interval: coverage probability of the intervals.
        strange: largest probability that a box looks less like the renders than a held-out render does; above it, the
            object's psi does not move. If psi has lights only, the limit is ``reading.BEYOND_ALL`` instead.
        doubt: an estimate is final if its expected total variation from the target's distribution is at most this.
        nearer: psi moves to an estimate that is not final only if its expected total variation from the target is at
            most this fraction of the present psi's. In the psi loop, the object then still takes steps along
            derivatives.
        skill: smallest accuracy on held-out renders, on a scale from 0 (chance) to 1; below it, psi does not move.
        fewest: smallest number of an object's boxes with which its psi may move; boxes of near-duplicate images count
            as one (``crops.views_of``).
        photographs: whether to expect images that differ from renders in more than psi: boxes are read at any roll,
            unless ``augmentation.roll_deg`` is set, and poses by comparison with the renders alone, because the
            network and the sizes of boxes mislead there. None: for targets of photographs.
        name: name in reports.
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
    nearer: Fraction = 0.5
    skill: Fraction = 0.15
    fewest: PositiveInt = 8
    photographs: bool | None = None
    name: str = "label_shift"

    def for_target(self, rendered: bool) -> LabelShift:
        """Return the settings with those chosen that depend on whether the target is rendered."""
        photographs, roll_deg = self.photographs, self.augmentation.roll_deg
        if photographs is None:
            photographs = not rendered
        if roll_deg is None:
            roll_deg = ANY_ROLL_DEG if photographs else RENDERED_ROLL_DEG
        return replace(
            self, photographs=photographs, augmentation=replace(self.augmentation, roll_deg=roll_deg)
        )
