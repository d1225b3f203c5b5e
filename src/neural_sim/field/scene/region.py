"""Find the cells of a scene's grid that are the object: connected, near the origin, above the supporting plane."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull
from torch import Tensor

from neural_sim.field.occupancy import dilate
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.plane import Plane
from neural_sim.field.scene.space import Frame, cells_of, contract, expand
from neural_sim.field.scene.surface import SeenSurface

SHOWS = 0.4
"""A cell is solid if it contributes more than this to some pixel."""
HITS = 2
"""A cell is also solid if this many rays end in it: each cell of a blurred surface contributes less."""
REACH = 1.5
"""The object lies inside the ball of this radius in the normalised frame."""
LARGE = 0.1
"""Connected parts with less than this fraction of the largest part's cells are errors of the field."""
FARTHEST = 0.9
"""Largest distance at which an object may end: from the origin, or from the axis through it if there is a plane."""
LEAST = 8
"""Smallest number of solid cells in an object."""
EMPTIER = 0.5
"""Largest density of solid cells around an object, relative to their density in the object."""
SPECK = 64
"""Smallest number of cells in a connected part of the scene's surface; smaller parts are errors of the field."""
APART = 1.0
"""Height in cells above the plane from which cells connect; lower, the plane's roughness would connect them."""
CLEAR = 2.0
"""The same in the second field: its cells are smaller, and a plane without texture bulges by more than one of them."""
MOST = 0.5
"""Smallest fraction of an object's solid cells above ``CLEAR``; flatter objects are searched for above ``APART``."""
GROUND = 1.0
"""Height in cells above the plane from which samples belong to the object."""
BULGE = 4.0
"""Height in cells up to which the surface of a plane without texture bulges towards the cameras."""
SOFT = 0.6
"""Largest fraction that a bulge's cells absorb, relative to the median of the object's cells above all bulges."""


@dataclass(frozen=True)
class Region:
    """The part of a grid's ``cells`` that lies more than ``ground`` above the plane, in the normalised frame."""

    cells: Bool[Tensor, "cells"]
    resolution: int
    plane: Plane | None
    ground: float

    def holds(self, contracted: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Tell whether contracted positions lie in the object."""
        return self.cells[cells_of(contracted, self.resolution)] & ~self.carries(contracted)

    def carries(self, contracted: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Tell whether contracted positions lie in or under the rough surface of the plane."""
        if self.plane is None:
            return torch.zeros(len(contracted), dtype=torch.bool)
        return self.plane.height(expand(contracted)) <= self.ground

    def cells_in(self, own: Frame, frame: Frame, resolution: int) -> Bool[Tensor, "cells"]:
        """Find the cells of another grid and frame that lie in this region's cells, at any height."""
        points = contract(own.of(frame, expand(cell_centres(resolution))))
        return self.cells[cells_of(points, self.resolution)]

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest corner of a box around the cells, in the normalised frame."""
        centres = expand(cell_centres(self.resolution)[self.cells])
        half = 2.0 / self.resolution
        return (centres.amin(0) - half).double().numpy(), (centres.amax(0) + half).double().numpy()


def cell_centres(resolution: int) -> Float[Tensor, "cells 3"]:
    """Return the contracted centres of all cells, in the order of ``cells_of``."""
    axis = (torch.arange(resolution) + 0.5) * (4.0 / resolution) - 2.0
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3)


def connected_region(
    grid: SceneGrid,
    surface: SeenSurface,
    plane: Plane | None,
    within: Bool[Tensor, "cells"] | None = None,
) -> Region | None:
    """Find the connected solid part nearest to the origin; None if there is none.

    ``within``, if given, holds the object and little else, so that all large solid parts in it are taken. Bulges of the
    plane connect with an object at its foot; so only what is above them is searched, and then continued down.
    """
    shows, allowed = surface.largest > SHOWS, _allowed(grid, plane, APART)
    if within is not None:
        solid = (shows | (surface.hits >= HITS)) & allowed & within
        clear = solid & _allowed(grid, plane, CLEAR)
        if not bool(solid.any()):
            return None
        if int(clear.sum()) < MOST * int(solid.sum()):
            return enclosed(grid, _large_parts(solid, grid.resolution), plane)
        return _down_to_the_plane(enclosed(grid, _large_parts(clear, grid.resolution), plane), grid)
    centres = expand(cell_centres(grid.resolution))
    distance = centres.norm(dim=-1) if plane is None else plane.from_axis(centres)
    # With large cells or few steps, some rays also end in the air, so more of them must end in a solid cell.
    for least in (HITS, 2 * HITS, 4 * HITS, 8 * HITS, math.inf):
        solid = (shows | (surface.hits >= least)) & allowed
        reach = _apart(distance[solid], 3 if plane is None else 2, grid.edge)
        if reach is not None:
            part = _nearest_part(solid & (distance < reach), centres, grid.resolution)
            return enclosed(grid, part, plane)
    return None


def _apart(distance: Float[Tensor, "solid"], dimensions: int, edge: float) -> float | None:
    """Find the ``distance`` at which the object ends; None if no gap surrounds it.

    The density of solid cells in rings two cells wide is compared with the density inside them: around an object, there
    is a ring that is much emptier, even if an error of the field bridges it.
    """
    inner = torch.arange(3, int(FARTHEST / edge)) * edge
    within = (distance[None] < inner[:, None]).sum(1)
    ring = (distance[None] < inner[:, None] + 2.0 * edge).sum(1) - within
    volume = inner**dimensions
    ratio = (ring / ((inner + 2.0 * edge) ** dimensions - volume)) / (within / volume).clamp_min(1e-12)
    ratio[within < LEAST] = float("inf")
    if not len(ratio) or float(ratio.min()) > EMPTIER:
        return None
    first = int((ratio <= max(1.2 * float(ratio.min()), 0.02)).int().argmax())
    return float(inner[first]) + edge


def _nearest_part(
    solid: Bool[Tensor, "cells"], centres: Float[Tensor, "cells 3"], side: int
) -> Bool[Tensor, "cells"]:
    """Return the large connected part nearest to the origin."""
    large = _large_parts(solid, side)
    label, count = _labelled(large, side)
    distance = centres.norm(dim=-1)
    nearest = torch.full((count + 1,), float("inf")).scatter_reduce(0, label, distance, "amin")
    return label == 1 + int(nearest[1:].argmin())


def _labelled(solid: Bool[Tensor, "cells"], side: int) -> tuple[Int[Tensor, "cells"], int]:
    """Label each cell with the number of its connected part, 0 if it is not solid, and count the parts."""
    parts = np.zeros((side, side, side), dtype=np.int64)
    scipy.ndimage.label(solid.view(side, side, side).numpy(), np.ones((3, 3, 3)), output=parts)
    return torch.from_numpy(parts).view(-1), int(parts.max())


def _large_parts(solid: Bool[Tensor, "cells"], side: int) -> Bool[Tensor, "cells"]:
    """Find the solid cells in connected parts that are large compared with the largest."""
    label, count = _labelled(solid, side)
    sizes = torch.bincount(label, minlength=count + 1)
    sizes[0] = 0
    return (sizes >= LARGE * float(sizes.max()))[label] & solid


def without_fog(grid: SceneGrid, surface: SeenSurface, region: Region) -> Bool[Tensor, "cells"]:
    """Select the cells in which rays end, their neighbours, and the region's own cells; all others hold fog.

    Where few cameras look, a field explains their photographs by thin fog in the air. No rays end in it, or only a few
    in one place, but in a mask it would hide the object.
    """
    side = grid.resolution
    label, count = _labelled(surface.hits >= HITS, side)
    sizes = torch.bincount(label, minlength=count + 1)
    sizes[0] = 0
    solid = (sizes >= SPECK)[label].view(side, side, side).float()
    return (dilate(solid).flatten() > 0) | region.cells


def without_bulges(grid: SceneGrid, surface: SeenSurface, region: Region) -> Region:
    """Take the bulges of the plane's surface out of a region.

    Photographs from one side leave the height of a plane without texture uncertain, so that its surface bulges between
    the feet of the object, by more than a cell, but absorbs less than the object. An object that is no higher than
    a bulge keeps its cells.
    """
    if region.plane is None:
        return region
    absorbed = grid.absorbed()
    above = region.plane.height(expand(cell_centres(grid.resolution))) > BULGE * grid.edge
    met = region.cells & above & (surface.hits >= HITS)
    if not bool(met.any()):
        return region
    dense = absorbed > SOFT * float(absorbed[met].median())
    return replace(region, cells=region.cells & (above | dense))


def _down_to_the_plane(region: Region, grid: SceneGrid) -> Region:
    """Add the cells between the plane and the region's cross-section half a cell above ``CLEAR``."""
    if region.plane is None:
        return region
    centres = expand(cell_centres(grid.resolution))
    height, level = region.plane.height(centres), (CLEAR + 0.5) * grid.edge
    raised = centres + (level - height)[:, None] * centres.new_tensor(region.plane.normal)
    covered = region.cells[cells_of(contract(raised), grid.resolution)]
    return replace(region, cells=region.cells | (covered & (height > 0.0) & (height < level)))


def enclosed(grid: SceneGrid, cells: Bool[Tensor, "cells"], plane: Plane | None) -> Region:
    """Return the region of all cells in the convex hull of the given cells and their neighbours.

    Surfaces inside a hollow, such as a mug's, are seen by few photographs and stay faint; the hull includes them. Empty
    parts of the hull absorb nothing and do not show in masks.
    """
    side = grid.resolution
    fringe: np.ndarray = np.asarray(
        scipy.ndimage.binary_dilation(cells.view(side, side, side).numpy(), np.ones((3, 3, 3)))
    )
    spans = [np.flatnonzero(fringe.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    near = np.zeros(fringe.shape, dtype=np.bool_)
    near[tuple(slice(span[0], span[-1] + 1) for span in spans)] = True
    centres = expand(cell_centres(side)[torch.from_numpy(near).view(-1)]).double().numpy()
    sides: np.ndarray = np.asarray(ConvexHull(centres[fringe[near]]).equations)
    near[near] = (centres @ sides[:, :3].T + sides[:, 3] <= 1e-9).all(1)
    inside = near.reshape(-1)
    return Region(torch.from_numpy(inside), side, plane, GROUND * grid.edge)


def _allowed(grid: SceneGrid, plane: Plane | None, cells: float) -> Bool[Tensor, "cells"]:
    """Find the cells within reach that are more than ``cells`` cells above the plane."""
    centres = expand(cell_centres(grid.resolution))
    inside = centres.norm(dim=-1) < REACH
    if plane is not None:
        inside &= plane.height(centres) > cells * grid.edge
    return inside
