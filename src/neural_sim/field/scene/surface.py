"""What of a scene photographs see: points of its surface, and the cells that show."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.field.quadrature import alpha_from_sigma, transmittance
from neural_sim.field.scene.fitting import ScenePixels, visible
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.space import Frame, cells_of, expand

AT_ONCE = 4096
"""Rays whose samples are in memory together."""


@torch.no_grad()
def seen_surface(
    grid: SceneGrid, pixels: ScenePixels, index: Int[Tensor, "some"], frame: Frame
) -> tuple[Float[Tensor, "hits 3"], Float[Tensor, "cells"]]:
    """Points in the normalised frame at which half of a ray's light has ended, and the largest contribution of each of
    the grid's cells to any of these pixels.
    """
    points, largest = [], torch.zeros(grid.resolution**3)
    for part in index.split(AT_ONCE):
        seen = visible(grid, pixels.rays(part, frame), torch.full((len(part),), 0.5), grid.samples)
        sigma = grid.density(grid.raw(seen.corners, seen.weights)[:, 0])
        reached = transmittance(sigma, seen.samples)
        weights = reached * alpha_from_sigma(sigma, seen.samples.width)
        largest.scatter_reduce_(0, cells_of(seen.positions, grid.resolution), weights, "amax")
        # Light falls along a ray: the last sample that half of it reaches is where the other half ends.
        lit = torch.nn.functional.pad((reached >= 0.5).long().cumsum(0), (1, 0))
        starts = seen.samples.starts
        last = starts[:-1] + lit[starts[1:]] - lit[starts[:-1]] - 1
        ended = torch.zeros(len(part)).index_add_(0, seen.samples.ray, weights) >= 0.5
        points.append(expand(seen.positions[last[ended]]))
    return torch.cat(points), largest
