"""Settings of the psi loop."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from neural_sim.checks import at_least
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.gradient.accumulated import Unrolled
from neural_sim.gradient.significance import SMALLEST
from neural_sim.parameter.update import Mirror, Update
from neural_sim.renderer.nerf import Quality

ObjectiveKind = Literal["average_precision", "accuracy", "loss"]
Start = Literal["previous", "warm", "fresh"]
AdjointKind = Literal["implicit", "unrolled"]
StepKind = Literal["checked", "free"]
OnUntrusted = Literal["shrink", "keep", "skip", "stop"]


@dataclass(frozen=True)
class Trust:
    """Conditions under which a psi step's hypergradient is trusted; None: no condition.

    The first four are on the whole hypergradient, ``level`` is on each object's derivative by each factor.

    Args:
        max_residual: relative residual of the adjoint solve (implicit adjoint).
        max_stationarity: ``|dL_train/dtheta|`` (implicit adjoint).
        max_sensitivity: relative change from lambda to 2 lambda (implicit adjoint; wants ``solver.sensitivity``).
        min_cosine: cosine with the response of training (wants ``outer.certify_every``).
        level: significance level of the test that a derivative is zero (see ``gradient.significance``).
        shrink: fraction of an untrusted step that is taken under ``outer.on_untrusted=shrink``.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    max_residual: float | None = 0.1
    max_stationarity: float | None = None
    max_sensitivity: float | None = None
    min_cosine: float | None = 0.0
    level: float | None = 0.1
    shrink: float = 0.25

    def __post_init__(self) -> None:
        limits = {
            "max_residual": self.max_residual, "max_stationarity": self.max_stationarity,
            "max_sensitivity": self.max_sensitivity,
        }  # fmt: skip
        at_least("outer.trust", 0, **{name: limit for name, limit in limits.items() if limit is not None})
        if self.min_cosine is not None and not -1.0 <= self.min_cosine <= 1.0:
            raise ValueError(f"outer.trust.min_cosine must lie in [-1, 1], got {self.min_cosine}")
        if self.level is not None and not SMALLEST <= self.level < 1.0:
            raise ValueError(
                f"outer.trust.level must lie in [{SMALLEST}, 1), below which no p-value lies, got {self.level}"
            )
        if not 0.0 < self.shrink < 1.0:
            raise ValueError(f"outer.trust.shrink must lie in (0, 1), got {self.shrink}")


@dataclass(frozen=True)
class Checks:
    """Trust-region steps, which another training accepts or rejects.

    Args:
        trainings: of the first iteration, whose derivatives are averaged; two tell how much trainings scatter. After
            one, the test knows the scatter of images alone.
        folds: disjoint parts of the validation images; each derivative is that of L_val on one of them, so that the
            scatter between derivatives has that of the validation images in it.
        radius: initial trust radius of each object and factor, in total variation (lights: half the absolute change of
            the weights).
        largest, smallest: bounds of the radius; an object below ``smallest`` does not move.
        keep: fraction of its p that a step leaves each bin; 0: no bound. The score is concave in a bin's images.
        level: significance level at which a step is accepted, by its derivative and its measured gain together.
        errors: standard errors by which an object's score must rise for its radius to grow, and fall for it to shrink
            by the whole factor.
        waits_below: an object does not move by a factor whose expected gain is below this fraction of the iteration's
            largest one: it waits until the large steps are done. Its own derivative is of a training with the others'
            present mistakes in it, and another once they have moved.
        grow, shrink: factors of the radius after an accepted step that raised the score and after one that lowered it;
            the latter's square root after another rejected step.
        momentum: factor of a derivative's weight in the average for every later move of its object.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    trainings: int = 2
    folds: int = 2
    radius: float = 0.3
    largest: float = 0.4
    smallest: float = 0.05
    keep: float = 0.3
    errors: float = 1.0
    level: float = 0.05
    waits_below: float = 0.2
    grow: float = 1.3
    shrink: float = 0.4
    momentum: float = 0.5

    def __post_init__(self) -> None:
        where = "outer.checks"
        if not 0.0 < self.smallest <= self.radius <= self.largest:
            raise ValueError(
                f"{where}: want 0 < smallest <= radius <= largest, got {self.smallest}, {self.radius}, {self.largest}"
            )
        at_least(where, 1, grow=self.grow, trainings=self.trainings, folds=self.folds)
        at_least(where, 0, momentum=self.momentum, errors=self.errors)
        if not 0.0 < self.level < 1.0:
            raise ValueError(f"{where}.level must lie in (0, 1), got {self.level}")
        if not 0.0 <= self.keep < 1.0:
            raise ValueError(f"{where}.keep must lie in [0, 1), got {self.keep}")
        if not 0.0 <= self.waits_below <= 1.0:
            raise ValueError(f"{where}: want waits_below in [0, 1], got {self.waits_below}")
        if not 0.0 < self.shrink < 1.0 or not self.momentum <= 1.0:
            raise ValueError(
                f"{where}: want shrink in (0, 1) and momentum in [0, 1], got {self.shrink} and {self.momentum}"
            )


@dataclass(frozen=True)
class Outer:
    """Settings of the psi loop.

    Args:
        update: the optimiser of free steps, for logits of bins.
        iterations: outer iterations.
        images_per_object: training images of each object in an iteration.
        epochs, learning_rate: of an iteration's training.
        least_steps: of that training, which has more epochs where these would give fewer steps: the images of one or
            two objects fill few batches, and so short a training says little about psi. Not of a training that goes on
            from the iteration before.
        loop_layers: last stages of the detector's backbone that this training changes, from the warm start's values;
            the others are frozen. None: as many as the detector proposes (:meth:`Detector.in_loop`).
        start: initial pyramid and head of that training: those of the iteration before (``previous``, the paper's), of
            the warm start (``warm``), or untrained ones, always the same (``fresh``). A detector that goes on remembers
            bins that psi has left, so that their loss stays low; an untrained one depends on the distribution alone.
        train_first: train before the first hypergradient; otherwise that is taken at the warm start.
        adjoint: the hypergradient of a stationary point, by the solver (``implicit``, the paper's Eq. 2), or of the
            training that was run (``unrolled``). The latter wants ``train_first`` and epochs.
        unrolled: settings of the unrolled adjoint.
        objective: L_val: one minus the smooth average precision of the validation images, or a classifier's smooth
            ``accuracy``, or their ``loss`` (the paper's).
        smooth_ap, smooth_accuracy: settings of that smooth average precision, and of that smooth accuracy.
        steps: ``checked``: in a trust region. Consecutive trainings use the same random numbers, and the last iteration
            only trains, to accept or reject the last step. ``free``: by ``update``.
        checks: settings of checked steps.
        final_step: free steps shorten linearly over the iterations to this fraction (Robbins and Monro 1951).
        curvature_images: training images of the Hessian products; 0: all.
        pool_per_bin: poses of every bin that are rendered once and then composited onto new backgrounds; 0: every image
            is rendered anew, as it always is for the pathwise estimator, which replays exact draws.
        refresh: fraction of the probes that an iteration replaces. The others keep their images, with the values that
            the other factors of p_psi had when they were drawn.
        quality: of the loop's renders; None: the renderer's own, which the scored detectors always train on.
        trust: conditions on the hypergradient.
        on_untrusted: what happens to steps that fail ``trust``: those of one factor of one object where its derivative
            is not significant, all of them where the whole hypergradient fails. ``keep`` takes them whole, as the paper
            does; ``stop`` skips the former, and ends the loop at the latter or where no step is left.
        learned: names of the objects whose psi a hypergradient moves; None: all that validation images show. The others
            get no probes and no second derivatives.
        light_update: the optimiser of free steps, for weights of lights.
        certify_every: iterations from one comparison of the hypergradient with the response of training at this psi
            (:mod:`outer.response`, one training for each bin) to the next; 0: never.

    Raises:
        ValueError: any of these out of its range, or a combination that cannot be, with the keys and the values.
    """

    update: Update
    iterations: int = 10
    images_per_object: int = 100
    epochs: int = 6
    least_steps: int = 0
    learning_rate: float = 3e-3
    loop_layers: int | None = None
    start: Start = "fresh"
    train_first: bool = True
    adjoint: AdjointKind = "unrolled"
    unrolled: Unrolled = field(default_factory=Unrolled)
    objective: ObjectiveKind = "average_precision"
    smooth_ap: SmoothAP = field(default_factory=SmoothAP)
    smooth_accuracy: SmoothAccuracy = field(default_factory=SmoothAccuracy)
    steps: StepKind = "checked"
    checks: Checks = field(default_factory=Checks)
    final_step: float = 0.1
    curvature_images: int = 64
    pool_per_bin: int = 48
    refresh: float = 0.5
    quality: Quality | None = None
    trust: Trust = field(default_factory=Trust)
    on_untrusted: OnUntrusted = "skip"
    learned: tuple[str, ...] | None = None
    light_update: Update = field(default_factory=lambda: Mirror(learning_rate=0.6, max_step=1.0))
    certify_every: int = 0

    def __post_init__(self) -> None:
        at_least("outer", 1, iterations=self.iterations, images_per_object=self.images_per_object)
        at_least(
            "outer", 0, epochs=self.epochs, learning_rate=self.learning_rate, least_steps=self.least_steps
        )
        at_least("outer", 0, curvature_images=self.curvature_images, pool_per_bin=self.pool_per_bin)
        at_least("outer", 0, certify_every=self.certify_every)
        if self.loop_layers is not None:
            at_least("outer", 0, loop_layers=self.loop_layers)
        if self.quality is not None and self.quality not in get_args(Quality):
            raise ValueError(
                f"outer.quality must be one of {', '.join(get_args(Quality))} or null, got {self.quality!r}"
            )
        if not 0.0 < self.refresh <= 1.0:
            raise ValueError(f"outer.refresh must lie in (0, 1], got {self.refresh}")
        if self.learned is not None and not self.learned:
            raise ValueError("outer.learned: want the names of objects, or null for all, got none")
        if not 0.0 < self.final_step <= 1.0:
            raise ValueError(f"outer.final_step must lie in (0, 1], got {self.final_step}")
        for key, kinds in (
            ("start", Start), ("adjoint", AdjointKind), ("objective", ObjectiveKind), ("steps", StepKind),
            ("on_untrusted", OnUntrusted),
        ):  # fmt: skip
            if getattr(self, key) not in get_args(kinds):
                raise ValueError(
                    f"outer.{key} must be one of {', '.join(get_args(kinds))}, got {getattr(self, key)!r}"
                )
        if self.steps == "checked" and (not self.train_first or self.start == "previous" or self.epochs == 0):
            raise ValueError(
                "outer.steps=checked compares trainings: want train_first=true, start=fresh or warm and epochs of at "
                f"least 1, got {self.train_first}, {self.start} and {self.epochs}"
            )
        if self.adjoint == "unrolled" and (not self.train_first or self.epochs == 0):
            raise ValueError(
                "outer.adjoint=unrolled wants train_first=true and epochs of at least 1, got "
                f"{self.train_first} and {self.epochs}"
            )

    @property
    def smooth(self) -> SmoothAP | SmoothAccuracy:
        """The smooth score of the objective; one of those where that is the loss."""
        return self.smooth_accuracy if self.objective == "accuracy" else self.smooth_ap
