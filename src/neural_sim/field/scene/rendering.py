"""Render the mask of the object in a photograph: the opacity of its region where nothing in front hides it."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.field.quadrature import render_weights, sum_rays, transmittance
from neural_sim.field.scene.fitting import visible
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.photographs import PhotoRays
from neural_sim.field.scene.region import Region
from neural_sim.field.scene.space import Frame
from neural_sim.field.scene.surface import AT_ONCE
from neural_sim.types import Rays

PHASES = (0.25, 0.75)
"""Shifts of the sample lattice that a pixel averages; with only one, a surface would show the lattice's steps."""

PINHOLE = 0.01
"""Area of a hole, relative to that of the mask, below which it is filled."""
FOG = 4.0
"""Nothing is hidden where 1 / ``FOG`` or more of the light passes what is in front; solids let less than 1 % pass."""


@torch.no_grad()
def object_mask(grid: SceneGrid, region: Region, rays: PhotoRays, frame: Frame) -> Float[Tensor, "h w"]:
    """Compute the object's opacity in [0, 1] at each pixel, where nothing solid in front hides it.

    Fog counts as transparent: where few photographs look, a field explains them by something thin in the air, which
    would otherwise hide the object. So does the plane: cameras are above it, so that it hides nothing that stands on
    it, but its rough surface would hide the object's foot.
    """
    height, width = rays.seen.shape
    directions = rays.directions.reshape(-1, 3).float()
    origin = frame.into(rays.origin).float()
    mask = torch.zeros(height * width)
    low, high = (torch.from_numpy(corner).float() for corner in region.corners())
    near = _meets(origin, directions, low, high) & rays.seen.flatten()
    for part in near.nonzero()[:, 0].split(AT_ONCE):
        bundle = Rays(origin.expand(len(part), 3), directions[part])
        for phase in PHASES:
            seen = visible(grid, bundle, torch.full((len(part),), phase), grid.samples)
            sigma = grid.density(grid.raw(seen.corners, seen.weights)[:, 0])
            inside = region.holds(seen.positions)
            before = transmittance(
                sigma.masked_fill(inside | region.carries(seen.positions), 0.0), seen.samples
            )
            weights = render_weights(sigma.masked_fill(~inside, 0.0), seen.samples)
            weights = weights * (FOG * before).clamp_max(1.0)
            mask[part] += sum_rays(weights[:, None], seen.samples)[:, 0] / len(PHASES)
    return without_pinholes(mask.view(height, width).clamp(0.0, 1.0))


def without_pinholes(mask: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Fill holes that are small for the object, as in walls that few photographs show; holes in handles are larger."""
    solid = (mask > 0.5).numpy()
    holes, count = scipy.ndimage.label(~solid)  # pyright: ignore[reportGeneralTypeIssues]
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    edge = np.unique(np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]]))
    small = sizes < PINHOLE * solid.sum()
    small[[0, *edge]] = False
    return torch.where(torch.from_numpy(small[holes]), 1.0, mask)


def _meets(
    origin: Float[Tensor, "3"],
    directions: Float[Tensor, "n 3"],
    low: Float[Tensor, "3"],
    high: Float[Tensor, "3"],
) -> Bool[Tensor, "n"]:
    """Tell whether rays pass through a box (slab test)."""
    slope = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    one, other = (low - origin) / slope, (high - origin) / slope
    return torch.minimum(one, other).amax(1).clamp_min(0.0) <= torch.maximum(one, other).amin(1)
