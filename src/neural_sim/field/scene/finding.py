"""Find the object in a fitted scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.field.scene.fitting import ScenePixels
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.plane import Plane, refitted, supporting_plane
from neural_sim.field.scene.region import (
    GROUND,
    Region,
    cell_centres,
    connected_region,
    without_bulges,
    without_fog,
)
from neural_sim.field.scene.space import Frame, expand
from neural_sim.field.scene.surface import seen_surface
from neural_sim.objects.capture import Capture
from neural_sim.objects.pictures import Corners

RAYS = 98_304
"""Number of pixels whose rays find the scene's surface."""
DETAILED = 3
"""The search for the plane uses one in this many of the surface's points: those of the pixels with the most detail."""
FAINT = 0.05
"""A box counts as empty if no cell in it contributes more than this to any pixel."""
THICK = 0.75
"""Distance in cells within which a point counts as on the plane: a fitted surface is about that thick."""


@dataclass(frozen=True)
class Found:
    """The object's region in the normalised frame, and its place in the capture's.

    ``centre``, ``radius`` and ``box`` are in the capture's frame. ``occupied`` marks the field's cells without fog and
    without bulges of the plane.
    """

    frame: Frame
    region: Region
    centre: Float[np.ndarray, "3"]
    radius: float
    box: tuple[np.ndarray, np.ndarray]
    occupied: Bool[Tensor, "cells"]


def find(
    grid: SceneGrid,
    pixels: ScenePixels,
    frame: Frame,
    capture: Capture,
    up: Float[Tensor, "3"],
    box: Corners | None,
    generator: torch.Generator,
    before: Found | None = None,
) -> Found:
    """Find the object in the field of a capture's scene.

    ``up`` and ``box`` are in the capture's frame. ``before`` is the object as found in a coarser field, which may have
    another frame.

    Raises:
        ValueError: there is nothing solid in the box or, without a box, near the origin.
    """
    index = torch.randperm(len(pixels), generator=generator)[:RAYS]
    index = index[pixels.detail[index].argsort(descending=True, stable=True)]
    surface = seen_surface(grid, pixels, index, frame)
    points = surface.points
    poses = np.stack([photo.camera_to_world for photo in capture.frames])
    cameras = frame.into(torch.from_numpy(poses[:, :3, 3]))
    if before is None:
        plane = supporting_plane(points[: len(points) // DETAILED], up, cameras, THICK * grid.edge, generator)
    else:
        coarse = before.region.plane
        plane = coarse and refitted(
            coarse.moved(before.frame, frame), points[: len(points) // DETAILED], THICK * grid.edge
        )
    middle = ", ".join(f"{x:.4g}" for x in frame.centre)
    if box is not None:
        region = _boxed(grid, surface.largest, plane, frame, box)
        if region is None:
            raise ValueError(
                f"objects.box: nothing of {capture.name} is in {[list(corner) for corner in box]}; want two corners "
                f"around the object, in the frame and the unit of {capture.source}"
            )
    else:
        within = None
        if before is not None:
            within = before.region.cells_in(before.frame, frame, grid.resolution)
        region = connected_region(grid, surface, plane, within)
        if region is None:
            raise ValueError(
                f"{capture.source}: objects.masks=scene does not find {capture.name} near ({middle}), where the "
                "cameras look; set objects.box to two corners around it, or give masks"
            )
    whole = region.cells
    if before is not None:
        region = without_bulges(grid, surface, region)
    low, high = (frame.out(corner) for corner in region.corners())
    centre = 0.5 * (low + high)
    cells = frame.out(expand(cell_centres(grid.resolution)[region.cells]).double().numpy())
    radius = float(np.linalg.norm(cells - centre, axis=1).max())
    corners = (low, high) if box is None else (np.array(box[0]), np.array(box[1]))
    occupied = without_fog(grid, surface, region) & (region.cells | ~whole)
    return Found(frame, region, centre, radius, corners, occupied)


def _boxed(
    grid: SceneGrid, largest: Float[Tensor, "cells"], plane: Plane | None, frame: Frame, box: Corners
) -> Region | None:
    """Find what is in the box above the plane (ignored if above the box's centre); None if nothing is solid."""
    low, high = (frame.into(torch.tensor(corner)) for corner in box)
    if plane is not None and float(plane.height(0.5 * (low + high))) < 0.0:
        plane = None  # the box's centre is below it, so it cannot support the object
    centres = expand(cell_centres(grid.resolution))
    inside: Bool[Tensor, "cells"] = ((centres > low) & (centres < high)).all(-1)
    region = Region(inside, grid.resolution, plane, GROUND * grid.edge)
    solid = inside & (largest > FAINT)
    if plane is not None:
        solid &= plane.height(centres) > 0.0
    return region if bool(solid.any()) else None
