"""A mask of the object in a photograph: the opacity of its region, behind whatever stands before it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.quadrature import render_weights, sum_rays
from neural_sim.field.scene.fitting import visible
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.photographs import PhotoRays
from neural_sim.field.scene.region import Region
from neural_sim.field.scene.space import Frame
from neural_sim.field.scene.surface import AT_ONCE
from neural_sim.types import Rays

PHASES = (0.25, 0.75)
"""Shifts of the samples' lattice that a pixel averages: with one alone a surface shows the lattice's steps."""


@torch.no_grad()
def object_mask(grid: SceneGrid, region: Region, rays: PhotoRays, frame: Frame) -> Float[Tensor, "h w"]:
    """Opacity in [0, 1] of the object at each pixel: the weights of the ray's samples in the region, summed."""
    height, width = rays.seen.shape
    directions = rays.directions.reshape(-1, 3).float()
    origin = frame.into(rays.origin).float()
    mask = torch.zeros(height * width)
    for part in rays.seen.flatten().nonzero()[:, 0].split(AT_ONCE):
        bundle = Rays(origin.expand(len(part), 3), directions[part])
        for phase in PHASES:
            seen = visible(grid, bundle, torch.full((len(part),), phase), grid.samples)
            weights = render_weights(grid.density(grid.raw(seen.corners, seen.weights)[:, 0]), seen.samples)
            weights = weights * region.holds(seen.positions)
            mask[part] += sum_rays(weights[:, None], seen.samples)[:, 0] / len(PHASES)
    return mask.view(height, width).clamp(0.0, 1.0)
