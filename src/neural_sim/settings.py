"""Budgets and sizes of a run's stages, validated where they are made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch

from neural_sim.cameras import orbit
from neural_sim.gradient.accumulated import Unrolled
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.parameter.illumination import ProjectedGradient
from neural_sim.parameter.update import Update
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.nerf import Quality
from neural_sim.renderer.rig import LightRig, VariedLight
from neural_sim.renderer.views import render_views
from neural_sim.types import PinholeCamera, PosedViews

Start = Literal["previous", "warm", "fresh"]
AdjointKind = Literal["implicit", "unrolled"]
OnUntrusted = Literal["shrink", "skip", "stop"]


def _at_least(where: str, smallest: float, **values: float) -> None:
    for name, value in values.items():
        if not value >= smallest:
            raise ValueError(f"{where}.{name} must be at least {smallest}, got {value}")


@dataclass(frozen=True)
class Views:
    """Posed views that train a field: uniform poses over both angles, uniform distances (paper, Sec. 4).

    ``image_size`` in pixels, ``distance_range`` in object radii; the last ``held_out`` views are never trained on.
    ``lights`` vary over the views; None: one fixed light.
    """

    count: int = 100
    held_out: int = 16
    image_size: int = 128
    field_of_view_deg: float = 40.0
    distance_range: tuple[float, float] = (2.4, 4.0)
    supersample: int = 2
    backend: Literal["auto", "pyrender", "raycast"] = "auto"
    lights: VariedLight | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _at_least("views", 1, count=self.count, image_size=self.image_size, supersample=self.supersample)
        _at_least("views", 0, held_out=self.held_out, seed=self.seed)
        if self.backend not in ("auto", "pyrender", "raycast"):
            raise ValueError(f"views.backend must be auto, pyrender or raycast, got {self.backend!r}")
        if not 1.0 < self.distance_range[0] <= self.distance_range[1]:
            raise ValueError(
                f"views.distance_range must be ordered and above 1 radius, got {self.distance_range}"
            )
        if self.lights is not None:
            self.lights.weights(
                self.count - self.held_out, torch.Generator()
            )  # each anchor lights a trained view

    def camera(self, image_size: int) -> PinholeCamera:
        """The square camera of this field of view."""
        return PinholeCamera(image_size, image_size, math.radians(self.field_of_view_deg))

    @property
    def rig(self) -> LightRig | None:
        """The anchor lights, None where the light is fixed."""
        return self.lights.rig if self.lights is not None else None

    def render(self, renderer: MeshRenderer, item: ObjectMesh) -> PosedViews:
        """All views of one object; equal seeds give equal poses and lights whatever the object."""
        generator = torch.Generator().manual_seed(self.seed)
        uniform = torch.rand((3, self.count), generator=generator)
        near, far = self.distance_range
        poses = orbit(2 * torch.pi * uniform[0], 2 * torch.pi * uniform[1], near + (far - near) * uniform[2])
        rig = weights = None
        if self.lights is not None:
            rig, weights = self.lights.rig, self.lights.weights(self.count, generator)
        return render_views(renderer, item, self.camera(self.image_size), poses, rig, weights)


@dataclass(frozen=True)
class Training:
    """What every detector trained from scratch gets, whatever the method that chose its images."""

    image_size: int = 96
    images_per_object: int = 100
    warm_epochs: int = 30
    cold_epochs: int = 30
    batch_size: int = 32
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        _at_least("training", 1, images_per_object=self.images_per_object, batch_size=self.batch_size)
        _at_least("training", 1, warm_epochs=self.warm_epochs, cold_epochs=self.cold_epochs)
        _at_least("training", 16, image_size=self.image_size)
        _at_least("training", 0, learning_rate=self.learning_rate, weight_decay=self.weight_decay)


@dataclass(frozen=True)
class Trust:
    """What a psi step's hypergradient must meet to be trusted; None makes no demand.

    ``max_residual`` of the adjoint solve, relative; ``max_stationarity`` of ``|dL_train/dtheta|``; ``max_sensitivity``
    of the relative change from lambda to 2 lambda (wants ``solver.sensitivity``); ``min_signal_to_noise`` of the best
    psi component of all objects; ``min_cosine`` with the retrained finite difference (wants ``outer.certify_every``).
    ``shrink`` is the part of an untrusted step that is taken where ``outer.on_untrusted`` says shrink.
    """

    max_residual: float | None = 0.1
    max_stationarity: float | None = None
    max_sensitivity: float | None = None
    min_signal_to_noise: float | None = 1.0
    min_cosine: float | None = 0.0
    shrink: float = 0.25

    def __post_init__(self) -> None:
        limits = {
            "max_residual": self.max_residual, "max_stationarity": self.max_stationarity,
            "max_sensitivity": self.max_sensitivity, "min_signal_to_noise": self.min_signal_to_noise,
        }  # fmt: skip
        _at_least("outer.trust", 0, **{name: limit for name, limit in limits.items() if limit is not None})
        if self.min_cosine is not None and not -1.0 <= self.min_cosine <= 1.0:
            raise ValueError(f"outer.trust.min_cosine must lie in [-1, 1], got {self.min_cosine}")
        if not 0.0 < self.shrink < 1.0:
            raise ValueError(f"outer.trust.shrink must lie in (0, 1), got {self.shrink}")


@dataclass(frozen=True)
class Outer:
    """The psi loop: how often, on how many images, how long the detector trains in between, and how psi steps.

    Each iteration's training starts from the pyramid and head of the iteration before (``previous``, the paper), of the
    warm start (``warm``) or from new ones, always the same (``fresh``). A detector that goes on remembers bins that psi
    has left, and its loss does not miss them; one that starts anew shows what the distribution itself teaches. The
    first iteration's hypergradient is taken at the warm start as it is, unless ``train_first``.
    psi's steps shorten linearly over the iterations to ``final_step`` of their length (Robbins and Monro 1951);
    ``update`` steps logits of bins, ``light_update`` weights of lights.
    ``adjoint`` says what the hypergradient is of: a stationary point, by the solver (``implicit``, the paper's Eq. 2),
    or the training that was run (``unrolled``, as ``unrolled`` says), which every iteration must then have: it wants
    ``train_first`` and epochs, and no retrained finite differences, which are of a stationary point.
    ``curvature_images`` of an iteration's training images make the Hessian products (0: all of them). ``pool_per_bin``
    poses of every bin are rendered once and composed afresh (0: every image is rendered anew); the pathwise
    estimator, which replays exact draws, always renders. ``refresh`` is the part of the probes that an iteration draws
    anew; the others keep their images, and what other factors of p_psi gave them. ``quality`` is that of the loop's
    renders (None: the renderer's own); the scored detectors always train on the renderer's. ``learned`` names the
    objects whose psi moves (None: all); for the others no probe is drawn and no second derivative taken.
    ``on_untrusted`` is what happens to a step that fails ``trust``. Every ``certify_every`` steps (0: never) one
    object's gradient, in turn, is compared with finite differences of a problem retrained on ``certify_per_bin`` images
    of every bin: 2 k - 1 trainings to stationarity.
    """

    update: Update
    iterations: int = 10
    images_per_object: int = 50
    epochs: int = 12
    learning_rate: float = 3e-3
    start: Start = "fresh"
    train_first: bool = False
    adjoint: AdjointKind = "implicit"
    unrolled: Unrolled = field(default_factory=Unrolled)
    final_step: float = 0.1
    curvature_images: int = 64
    pool_per_bin: int = 24
    refresh: float = 0.5
    quality: Quality | None = None
    trust: Trust = field(default_factory=Trust)
    on_untrusted: OnUntrusted = "shrink"
    learned: tuple[str, ...] | None = None
    light_update: ProjectedGradient = field(default_factory=ProjectedGradient)
    certify_every: int = 0
    certify_per_bin: int = 1

    def __post_init__(self) -> None:
        _at_least("outer", 1, iterations=self.iterations, images_per_object=self.images_per_object)
        _at_least("outer", 0, epochs=self.epochs, learning_rate=self.learning_rate)
        _at_least("outer", 0, curvature_images=self.curvature_images, pool_per_bin=self.pool_per_bin)
        _at_least("outer", 0, certify_every=self.certify_every)
        if self.quality is not None and self.quality not in get_args(Quality):
            raise ValueError(
                f"outer.quality must be one of {', '.join(get_args(Quality))} or null, got {self.quality!r}"
            )
        if not 0.0 < self.refresh <= 1.0:
            raise ValueError(f"outer.refresh must lie in (0, 1], got {self.refresh}")
        _at_least("outer", 1, certify_per_bin=self.certify_per_bin)
        if self.start not in get_args(Start):
            raise ValueError(f"outer.start must be one of {', '.join(get_args(Start))}, got {self.start!r}")
        if self.learned is not None and not self.learned:
            raise ValueError("outer.learned: want the names of objects, or null for all, got none")
        if not 0.0 < self.final_step <= 1.0:
            raise ValueError(f"outer.final_step must lie in (0, 1], got {self.final_step}")
        if self.adjoint not in get_args(AdjointKind):
            raise ValueError(
                f"outer.adjoint must be one of {', '.join(get_args(AdjointKind))}, got {self.adjoint!r}"
            )
        if self.adjoint == "unrolled" and (not self.train_first or self.epochs == 0 or self.certify_every):
            raise ValueError(
                "outer.adjoint=unrolled wants train_first=true, epochs of at least 1 and certify_every=0, got "
                f"{self.train_first}, {self.epochs} and {self.certify_every}"
            )
        if self.on_untrusted not in get_args(OnUntrusted):
            raise ValueError(
                f"outer.on_untrusted must be one of {', '.join(get_args(OnUntrusted))}, got {self.on_untrusted!r}"
            )
