"""Settings of the psi loop."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from neural_sim.checks import at_least
from neural_sim.detector.smooth_ap import SmoothAP
from neural_sim.gradient.accumulated import Unrolled
from neural_sim.gradient.significance import SMALLEST
from neural_sim.parameter.update import Mirror, Update
from neural_sim.renderer.nerf import Quality

ObjectiveKind = Literal["average_precision", "loss"]
Start = Literal["previous", "warm", "fresh"]
AdjointKind = Literal["implicit", "unrolled"]
CertifyKind = Literal["response", "retrained"]
StepKind = Literal["checked", "free"]
OnUntrusted = Literal["shrink", "keep", "skip", "stop"]


@dataclass(frozen=True)
class Trust:
    """What a psi step's hypergradient must meet to be trusted; None makes no demand.

    ``max_residual`` of the adjoint solve, relative; ``max_stationarity`` of ``|dL_train/dtheta|``; ``max_sensitivity``
    of the relative change from lambda to 2 lambda (wants ``solver.sensitivity``); these three are of the implicit
    adjoint. ``min_cosine`` is with what ``outer.certify`` measures (wants ``outer.certify_every``). These speak of all
    objects. ``level`` speaks of each object and factor of psi: the probability with which an iteration's derivative
    that is zero passes for one that is not (see ``gradient.significance``). ``shrink`` is the part of an untrusted step
    that is taken where ``outer.on_untrusted`` says shrink.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    max_residual: float | None = 0.1
    max_stationarity: float | None = None
    max_sensitivity: float | None = None
    min_cosine: float | None = 0.0
    level: float | None = 0.05
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
    """Steps that the next iteration's training accepts or undoes.

    Args:
        radius: of each object's first step by a factor, in total variation (of lights: half the absolute change of the
            weights).
        largest, smallest: radii; under ``smallest`` an object rests.
        errors: standard errors by which an object's own score must rise for its step to be kept.
        grow, shrink: what an accepted and an undone step multiply the radius by.
        momentum: what an iteration's derivative counts in the next one's average, before noise is weighed.
        max_step: the most by which a step changes a logit (or a weight).

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    radius: float = 0.5
    largest: float = 0.7
    smallest: float = 0.05
    errors: float = 1.0
    grow: float = 1.3
    shrink: float = 0.4
    momentum: float = 0.5
    max_step: float = 4.0

    def __post_init__(self) -> None:
        where = "outer.checks"
        if not 0.0 < self.smallest <= self.radius <= self.largest:
            raise ValueError(
                f"{where}: want 0 < smallest <= radius <= largest, got {self.smallest}, {self.radius}, {self.largest}"
            )
        at_least(where, 1, grow=self.grow)
        at_least(where, 0, momentum=self.momentum, errors=self.errors)
        if not 0.0 < self.shrink < 1.0 or not self.momentum <= 1.0 or not self.max_step > 0.0:
            raise ValueError(
                f"{where}: want shrink in (0, 1), momentum in [0, 1] and max_step above 0, got {self.shrink}, "
                f"{self.momentum} and {self.max_step}"
            )


@dataclass(frozen=True)
class Outer:
    """The psi loop: how often, on how many images, how long the detector trains in between, and how psi steps.

    Each iteration's training starts from the pyramid and head of the iteration before (``previous``, the paper), of the
    warm start (``warm``) or from new ones, always the same (``fresh``). A detector that goes on remembers bins that psi
    has left, and its loss does not miss them; one that starts anew shows what the distribution itself teaches. The
    first iteration's hypergradient is taken at the warm start as it is, unless ``train_first``.
    psi's steps shorten linearly over the iterations to ``final_step`` of their length (Robbins and Monro 1951);
    ``update`` steps logits of bins, ``light_update`` weights of lights.
    ``curvature_images`` of an iteration's training images make the Hessian products (0: all of them). ``pool_per_bin``
    poses of every bin are rendered once and composed afresh (0: every image is rendered anew); the pathwise
    estimator, which replays exact draws, always renders. ``refresh`` is the part of the probes that an iteration draws
    anew; the others keep their images, and what other factors of p_psi gave them. ``quality`` is that of the loop's
    renders (None: the renderer's own); the scored detectors always train on the renderer's. ``learned`` names the
    objects whose psi moves (None: all); for the others no probe is drawn and no second derivative taken.
    ``objective`` is L_val: one minus the smooth average precision of the validation images (``smooth_ap`` says how
    smooth), or their ``loss``, as in the paper.
    ``steps`` are ``checked`` as ``checks`` says: every iteration trains under the same random numbers, and the last one
    trains only to judge the last step; or ``free``, by ``update``.
    ``adjoint`` says what the hypergradient is of: a stationary point, by the solver (``implicit``, the paper's Eq. 2),
    or the training that was run (``unrolled``, as ``unrolled`` says), which every iteration must then have: it wants
    ``train_first`` and epochs, and no retrained finite differences, which are of a stationary point.
    ``on_untrusted`` is what happens to a step that fails ``trust``: the step of one factor of one object where its
    derivative is not significant, of all where the doubt is about all. ``keep`` takes it whole, as the paper does;
    ``stop`` skips the former, and ends the loop at the latter or where no object is left. Every ``certify_every`` steps
    (0: never) the hypergradient is compared: with the ``response`` of training itself at this psi, a training for each
    bin (:mod:`outer.response`), or with finite differences of a problem ``retrained`` to stationarity on
    ``certify_per_bin`` images of every bin, one object in turn, 2 k - 1 such trainings.
    """

    update: Update
    iterations: int = 10
    images_per_object: int = 50
    epochs: int = 12
    learning_rate: float = 3e-3
    start: Start = "fresh"
    train_first: bool = True
    adjoint: AdjointKind = "unrolled"
    unrolled: Unrolled = field(default_factory=Unrolled)
    objective: ObjectiveKind = "average_precision"
    smooth_ap: SmoothAP = field(default_factory=SmoothAP)
    steps: StepKind = "checked"
    checks: Checks = field(default_factory=Checks)
    final_step: float = 0.1
    curvature_images: int = 64
    pool_per_bin: int = 24
    refresh: float = 0.5
    quality: Quality | None = None
    trust: Trust = field(default_factory=Trust)
    on_untrusted: OnUntrusted = "skip"
    learned: tuple[str, ...] | None = None
    light_update: Update = field(default_factory=lambda: Mirror(learning_rate=0.6, max_step=1.0))
    certify: CertifyKind = "response"
    certify_every: int = 0
    certify_per_bin: int = 1

    def __post_init__(self) -> None:
        at_least("outer", 1, iterations=self.iterations, images_per_object=self.images_per_object)
        at_least("outer", 0, epochs=self.epochs, learning_rate=self.learning_rate)
        at_least("outer", 0, curvature_images=self.curvature_images, pool_per_bin=self.pool_per_bin)
        at_least("outer", 0, certify_every=self.certify_every)
        if self.quality is not None and self.quality not in get_args(Quality):
            raise ValueError(
                f"outer.quality must be one of {', '.join(get_args(Quality))} or null, got {self.quality!r}"
            )
        if not 0.0 < self.refresh <= 1.0:
            raise ValueError(f"outer.refresh must lie in (0, 1], got {self.refresh}")
        at_least("outer", 1, certify_per_bin=self.certify_per_bin)
        if self.start not in get_args(Start):
            raise ValueError(f"outer.start must be one of {', '.join(get_args(Start))}, got {self.start!r}")
        if self.learned is not None and not self.learned:
            raise ValueError("outer.learned: want the names of objects, or null for all, got none")
        if not 0.0 < self.final_step <= 1.0:
            raise ValueError(f"outer.final_step must lie in (0, 1], got {self.final_step}")
        if self.on_untrusted not in get_args(OnUntrusted):
            raise ValueError(
                f"outer.on_untrusted must be one of {', '.join(get_args(OnUntrusted))}, got {self.on_untrusted!r}"
            )
        for key, kinds in (
            ("adjoint", AdjointKind),
            ("objective", ObjectiveKind),
            ("steps", StepKind),
            ("certify", CertifyKind),
        ):
            if getattr(self, key) not in get_args(kinds):
                raise ValueError(
                    f"outer.{key} must be one of {', '.join(get_args(kinds))}, got {getattr(self, key)!r}"
                )
        if self.steps == "checked" and (not self.train_first or self.start == "previous" or self.epochs == 0):
            raise ValueError(
                "outer.steps=checked compares trainings: want train_first=true, start=fresh or warm and epochs of at "
                f"least 1, got {self.train_first}, {self.start} and {self.epochs}"
            )
        retrained = self.certify_every > 0 and self.certify == "retrained"
        if self.adjoint == "unrolled" and (not self.train_first or self.epochs == 0 or retrained):
            raise ValueError(
                "outer.adjoint=unrolled wants train_first=true, epochs of at least 1 and no certify=retrained, got "
                f"{self.train_first}, {self.epochs} and certify_every={self.certify_every} of {self.certify}"
            )
