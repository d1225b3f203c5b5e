"""Settings of the psi loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import MinLen

from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.configuration import UserError
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.certificate import Trust
from neural_sim.outer.first_step import Derivative
from neural_sim.outer.objective import Loss
from neural_sim.outer.steps import FreeSteps
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.ranges import NonNegative, NonNegativeInt, PositiveFraction, PositiveInt, validated


@validated
@dataclass(frozen=True)
class Outer:
    """The psi loop.

    Args:
        iterations: largest number of outer iterations.
        patience: number of consecutive iterations without a step to try, after which a loop with a trust region ends;
            None: all iterations are run.
        images_per_object: number of training images of each object in an iteration.
        epochs: epochs of an iteration's training.
        learning_rate: peak learning rate of that training.
        least_steps: minimum number of optimiser steps of that training; its epochs are raised to reach it. The images
            of one or two objects fill few batches, and such a short training says little about psi. Does not apply to a
            training that continues the previous iteration's.
        loop_layers: number of last stages of the detector's backbone that this training changes, starting from the warm
            start's values; the others are frozen. None: as many as the detector proposes (``Detector.in_loop``).
        start: initial pyramid and head of that training: those of the previous iteration (``previous``, the paper's),
            of the warm start (``warm``), or untrained ones, always the same (``fresh``). A detector that continues
            remembers bins that psi has left, so that their loss stays low; what an untrained one learns depends on the
            present distribution alone.
        train_first: train before the first hypergradient; otherwise it is taken at the warm start.
        pool_per_bin: number of renders of every bin that are made once and then composed with new backgrounds; 0: every
            image is rendered anew, as always if images are differentiated (``gradient=pathwise``) or psi has lights.
        refresh: fraction of the probes that an iteration replaces. The others keep their images, whose other factors
            follow the psi at which they were drawn.
        learned: names of the objects whose psi a hypergradient moves; None: all that validation images show. The others
            get no probes and no second derivatives. A trust region leaves out those that no validation image shows.
        certify_every: number of iterations between comparisons of the hypergradient with the finite-difference response
            of training at the same psi (``outer.response``, one training for each bin); 0: never.
        first_step: where the loop goes first: along the first derivative, or to an estimate from the target's boxes;
            then only the objects that it could not estimate, or whose estimate a training rejected, follow derivatives.
            For objects that are neither estimated nor found by the detector, it is a guess (``with_guesses``).
        steps: how psi follows its derivative: freely, or in a trust region. A trust region uses common random numbers,
            and its last iteration only trains, to accept or reject the last step.
        adjoint: the hypergradient of the training that was run, or that at a stationary point (the paper's Eq. 2).
        objective: what is minimised on the validation images: one minus a smooth average precision, one minus a
            classifier's smooth accuracy, or their loss (the paper's).
        trust: conditions on the hypergradient.

    Raises:
        UserError: the combination of settings is impossible.
    """

    iterations: PositiveInt = 10
    images_per_object: PositiveInt = 100
    epochs: NonNegativeInt = 6
    learning_rate: NonNegative = 3e-3
    least_steps: NonNegativeInt = 0
    loop_layers: NonNegativeInt | None = None
    start: Literal["previous", "warm", "fresh"] = "fresh"
    train_first: bool = True
    pool_per_bin: NonNegativeInt = 48
    refresh: PositiveFraction = 0.5
    learned: Annotated[Sequence[str], MinLen(1)] | None = None
    certify_every: NonNegativeInt = 0
    patience: PositiveInt | None = None
    first_step: Derivative | LabelShift = field(default_factory=Derivative)
    steps: TrustRegion | FreeSteps = field(default_factory=TrustRegion)
    adjoint: Unrolled | Implicit = field(default_factory=Unrolled)
    objective: SmoothAP | SmoothAccuracy | Loss = field(default_factory=SmoothAP)
    trust: Trust = field(default_factory=Trust)

    def __post_init__(self) -> None:
        trains = self.train_first and self.epochs > 0
        if isinstance(self.steps, TrustRegion) and (not trains or self.start == "previous"):
            raise UserError(
                "outer/steps=trust_region compares trainings: want train_first=true, start=fresh or warm and epochs of "
                f"at least 1, got {self.train_first}, {self.start} and {self.epochs}"
            )
        if not isinstance(self.first_step, Derivative) and not isinstance(self.steps, TrustRegion):
            raise UserError(
                "outer/first_step: a training must accept or reject the proposal: want outer/steps=trust_region with "
                "it, or outer/first_step=derivative"
            )
        if isinstance(self.adjoint, Unrolled) and not trains:
            raise UserError(
                "outer/adjoint=unrolled wants train_first=true and epochs of at least 1, got "
                f"{self.train_first} and {self.epochs}"
            )
