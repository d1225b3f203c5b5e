"""Budgets and sizes of a run's stages, validated where they are made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from neural_sim.parameter.update import Update
from neural_sim.types import PinholeCamera


def _at_least(where: str, smallest: float, **values: float) -> None:
    for name, value in values.items():
        if not value >= smallest:
            raise ValueError(f"{where}.{name} must be at least {smallest}, got {value}")


@dataclass(frozen=True)
class Views:
    """Posed views that train a field: uniform poses over both angles, uniform distances (paper, Sec. 4).

    ``image_size`` in pixels, ``distance_range`` in object radii; the last ``held_out`` views are never trained on.
    """

    count: int = 100
    held_out: int = 16
    image_size: int = 128
    field_of_view_deg: float = 40.0
    distance_range: tuple[float, float] = (2.4, 4.0)
    supersample: int = 2
    backend: Literal["auto", "pyrender", "raycast"] = "auto"
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

    def camera(self, image_size: int) -> PinholeCamera:
        """The square camera of this field of view."""
        return PinholeCamera(image_size, image_size, math.radians(self.field_of_view_deg))


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
class Outer:
    """The psi loop: how often, on how many images, how long the detector trains in between, and how psi steps.

    ``curvature_images`` of an iteration's training images make the Hessian products (0: all of them). ``pool_per_bin``
    poses of every bin are rendered once and composed afresh (0: every image is rendered anew); the pathwise
    estimator, which replays exact draws, always renders.
    """

    update: Update
    iterations: int = 10
    images_per_object: int = 50
    epochs: int = 2
    learning_rate: float = 5e-4
    curvature_images: int = 64
    pool_per_bin: int = 24

    def __post_init__(self) -> None:
        _at_least("outer", 1, iterations=self.iterations, images_per_object=self.images_per_object)
        _at_least("outer", 0, epochs=self.epochs, learning_rate=self.learning_rate)
        _at_least("outer", 0, curvature_images=self.curvature_images, pool_per_bin=self.pool_per_bin)
