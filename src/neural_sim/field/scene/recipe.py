"""Compute masks of the object in a captured scene, from a coarse field of the whole scene, then from a finer one."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, MultipleOf
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.scene.finding import Found, find
from neural_sim.field.scene.fitting import Budget, ScenePixels, fit
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.photographs import photo_rays, scene_pixels
from neural_sim.field.scene.rendering import object_mask
from neural_sim.field.scene.space import Frame, looked_at
from neural_sim.objects.capture import Capture
from neural_sim.objects.pictures import Corners, Direction
from neural_sim.objects.placing import mean_up
from neural_sim.ranges import NonNegativeInt, PositiveInt, validated

_log = logging.getLogger(__name__)

CAMERAS_AT = 2.0
"""Median camera distance in the first field's frame: cameras lie outside the ball that is not contracted."""
ROOM = 1.0
"""Radius of the ball that the second field does not contract, in radii of the object that the first field found."""
COARSE = 0.5
"""Steps, cells per side and pixels per side of the first field, relative to the second's."""
LEAST_PIXELS = 80
"""Smallest number of pixels along the longer side of the first field's photographs."""


@validated
@dataclass(frozen=True)
class SceneMasks:
    """Masks from a field of the whole scene.

    A first field, of half the resolution, shows the supporting plane and on it the object that the cameras look at. The
    second field has the object at its centre, where its cells are finest, and renders the masks.

    Args:
        image_size: longer side in pixels of the photographs that train the field, and of the masks.
        resolution: number of the field's cells along each side of contracted space.
        steps: budget of optimiser steps.
        batch_rays: number of rays in a step.
        seed: seed of the order of rays; separate from the run's seed, so that runs share masks.
    """

    image_size: Annotated[int, Ge(16)] = 160
    resolution: Annotated[int, Ge(16), MultipleOf(4)] = 96
    steps: PositiveInt = 240
    batch_rays: PositiveInt = 2048
    seed: NonNegativeInt = 0

    def masks(
        self, capture: Capture, up: Direction | None, box: Corners | None
    ) -> tuple[Float[Tensor, "_ _"], ...]:
        """Compute the object's opacity in [0, 1] in each photograph, ``image_size`` pixels along its longer side.

        ``up`` is in the capture's frame; None: that of its file, or else the mean of the cameras' up vectors. With
        ``box``, the object is everything in the box above the plane; without it, the connected part nearest to the
        point that the cameras look at.

        Raises:
            ValueError: the cameras do not look at one place, no object is found, or the box is empty.
        """
        poses = np.stack([frame.camera_to_world for frame in capture.frames])
        upward = torch.tensor(up or capture.up or mean_up(capture), dtype=torch.float64)
        generator = torch.Generator().manual_seed(self.seed)
        if box is None:
            point, distance = looked_at(poses, capture.name)
            frame = Frame(_three(point), distance / CAMERAS_AT)
        else:
            low, high = np.array(box)
            frame = Frame(_three(0.5 * (low + high)), ROOM * 0.5 * float(np.linalg.norm(high - low)))
        pixels, grid = self._fit(capture, frame, COARSE, generator)
        first = find(grid, pixels, frame, capture, upward, box, generator)
        finer = Frame(_three(first.centre), ROOM * first.radius)
        pixels, grid = self._fit(capture, finer, 1.0, generator, grid.moved(frame, finer))
        found = find(grid, pixels, finer, capture, upward, box, generator, first)
        grid.occupied &= found.occupied
        masks = tuple(
            object_mask(grid, found.region, photo_rays(photo, self.image_size), finer)
            for photo in capture.frames
        )
        _tell(capture, found, masks)
        return masks

    def _fit(
        self,
        capture: Capture,
        frame: Frame,
        part: float,
        generator: torch.Generator,
        start: SceneGrid | None = None,
    ) -> tuple[ScenePixels, SceneGrid]:
        """Fit a field with the fraction ``part`` of the pixels per side, steps and cells per side."""
        pixels = scene_pixels(capture, min(self.image_size, max(LEAST_PIXELS, round(part * self.image_size))))
        budget = Budget(max(1, round(part * self.steps)), self.batch_rays, round(part * self.resolution))
        return pixels, fit(pixels, frame, budget, generator, start).grid


def _tell(capture: Capture, found: Found, masks: tuple[Tensor, ...]) -> None:
    """Log the object that was found."""
    covered = [float((mask > 0.5).float().mean()) for mask in masks]
    low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in found.box)
    plane = found.region.plane
    stands = "stands on no plane"
    if plane is not None:
        foot = found.frame.out(np.array(plane.normal) * plane.offset)
        place = ", ".join(f"{x:.4g}" for x in foot)
        normal = ", ".join(f"{x:.3f}" for x in plane.normal)
        stands = f"stands on the plane through ({place}) with normal ({normal})"
    _log.info(
        "%s: the object %s and has the box [[%s], [%s]] in the capture's frame; it covers %.1f %% of a photograph "
        "(median; %.1f to %.1f %%). objects.box sets another box",
        capture.name, stands, low, high, 100.0 * float(np.median(covered)), 100.0 * min(covered), 100.0 * max(covered),
    )  # fmt: skip


def _three(point: np.ndarray) -> Direction:
    x, y, z = (float(value) for value in point)
    return x, y, z
