"""The visual hull: cells that no view's silhouette rules out (Laurentini 1994), carved coarse to fine."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.field.occupancy import subdivide
from neural_sim.ranges import Matching, check
from neural_sim.types import PosedViews

COARSEST = 32
Resolution = Annotated[
    int,
    Matching(
        lambda cells: cells >= COARSEST and cells & (cells - 1) == 0, f"a power of two of at least {COARSEST}"
    ),
]
"""Number of cells along the unit sphere's diameter, such that they can be carved coarse to fine."""
DISSENT = 0.1
"""A cell stays if at most this fraction of the photographs that show it have no object there, because poses and masks
are inexact."""


def visual_hull(
    views: PosedViews, resolution: int, alpha_threshold: float = 0.004
) -> tuple[Bool[Tensor, "nx ny nz"], Float[Tensor, "3"], float]:
    """Find the cells of the unit sphere that the object may occupy; [-1, 1]^3 has ``resolution`` along each edge.

    A cell is removed if some view that sees its centre has no pixel above ``alpha_threshold`` in a square that contains
    the cell's projection, so that the hull is never too small. With photographs (``views.known``), more than the
    fraction ``DISSENT`` of those that show the cell must agree to remove it. Returns cells, origin and edge length in
    object radii.

    Raises:
        ValueError: the resolution is invalid, or no cell is left (the silhouettes contradict each other).
    """
    check(resolution, Resolution, "visual_hull.resolution")
    pose = views.camera_to_world
    origin = torch.full((3,), -1.0, dtype=pose.dtype, device=pose.device)
    size = COARSEST
    occupied = torch.ones(size, size, size, dtype=torch.bool, device=pose.device)
    while True:
        cell = 2.0 / size
        where = occupied.nonzero()
        centres = origin + (where.to(pose.dtype) + 0.5) * cell
        radius = 0.5 * math.sqrt(3.0) * cell
        in_sphere = centres.norm(dim=-1) < 1.0 + radius
        where, centres = where[in_sphere], centres[in_sphere]
        kept = where[_inside_all(views, centres, radius, alpha_threshold)]
        if not len(kept):
            raise ValueError(
                f"visual_hull: the silhouettes of {len(views)} views share no cell; check alpha and poses"
            )
        occupied = torch.zeros_like(occupied)
        occupied[kept.unbind(1)] = True
        if size == resolution:
            return occupied, origin, cell
        occupied, size = subdivide(occupied), 2 * size


def pixels_across(views: PosedViews, length: float) -> int:
    """Bound the number of pixels that a length in the unit sphere covers in any view.

    A camera nearer to the sphere than 0.25 counts as 0.25 away.
    """
    nearest = max(float(views.camera_to_world[:, :3, 3].norm(dim=-1).min()) - 1.0, 0.25)
    return math.ceil(max(focal_lengths(views.camera)) * length / nearest) + 1


def _inside_all(
    views: PosedViews, centres: Float[Tensor, "cells 3"], radius: float, alpha_threshold: float
) -> Bool[Tensor, "cells"]:
    """Find the centres within ``radius`` of the silhouettes in the views that see them; unseen centres stay."""
    camera, reach = views.camera, pixels_across(views, radius)
    (fx, fy), (cx, cy) = focal_lengths(camera), principal_point(camera)
    mask = views.images[..., 3] > alpha_threshold
    mask = (mask if views.known is None else mask | ~views.known).to(centres.dtype)[:, None]
    mask = functional.max_pool2d(mask, (2 * reach + 1, 1), 1, (reach, 0))
    mask = functional.max_pool2d(mask, (1, 2 * reach + 1), 1, (0, reach))[:, 0] > 0
    inside = torch.ones(len(centres), dtype=torch.bool, device=centres.device)
    remaining = torch.arange(len(centres), device=centres.device)
    allowed = 0.0 if views.known is None else DISSENT
    seen_by, missed_by = torch.zeros(2, len(centres), device=centres.device)
    for number, (pose, silhouette) in enumerate(zip(views.camera_to_world, mask, strict=True)):
        local = (centres[remaining] - pose[:3, 3]) @ pose[:3, :3]
        depth = (-local[:, 2]).clamp_min(1e-6)
        column = (fx * local[:, 0] / depth + cx).floor().long()
        row = (-fy * local[:, 1] / depth + cy).floor().long()
        seen = (
            (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (local[:, 2] < 0)
        )
        row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        hit = silhouette[row, column]
        if views.known is not None:
            seen &= views.known[number][row, column]
            seen_by += seen
            missed_by += seen & ~hit
            continue
        inside[remaining[seen & ~hit]] = False
        remaining = remaining[~seen | hit]
    return inside & (missed_by <= allowed * seen_by)
