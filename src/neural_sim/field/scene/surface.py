"""Find what photographs show of a scene: points of its surface, and the visible cells."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.field.quadrature import alpha_from_sigma, transmittance
from neural_sim.field.scene.fitting import ScenePixels, visible
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.space import Frame, cells_of, contract, expand

AT_ONCE = 4096
"""Number of rays whose samples are in memory together."""


@dataclass(frozen=True)
class SeenSurface:
    """The surfaces that rays meet.

    ``points`` are the places where rays have lost half of their light, in the normalised frame; ``hits`` is their
    number in each of the grid's cells; ``largest`` is the largest contribution of each cell to any pixel.

    A field fitted in few steps spreads a surface over several cells, each of which contributes little; but the point
    where half of the light is lost remains well defined.
    """

    points: Float[Tensor, "hits 3"]
    hits: Float[Tensor, "cells"]
    largest: Float[Tensor, "cells"]


@torch.no_grad()
def seen_surface(
    grid: SceneGrid, pixels: ScenePixels, index: Int[Tensor, "some"], frame: Frame
) -> SeenSurface:
    """Find the surfaces that the rays of these pixels meet."""
    points, largest = [], torch.zeros(grid.resolution**3)
    for part in index.split(AT_ONCE):
        seen = visible(grid, pixels.rays(part, frame), torch.full((len(part),), 0.5), grid.samples)
        sigma = grid.density(grid.raw(seen.corners, seen.weights)[:, 0])
        reached = transmittance(sigma, seen.samples)
        weights = reached * alpha_from_sigma(sigma, seen.samples.width)
        largest.scatter_reduce_(0, cells_of(seen.positions, grid.resolution), weights, "amax")
        # Transmittance falls along a ray: half of the light is lost in the last sample that half of it reaches.
        lit = torch.nn.functional.pad((reached >= 0.5).long().cumsum(0), (1, 0))
        starts = seen.samples.starts
        last = starts[:-1] + lit[starts[1:]] - lit[starts[:-1]] - 1
        ended = torch.zeros(len(part)).index_add_(0, seen.samples.ray, weights) >= 0.5
        points.append(expand(seen.positions[last[ended]]))
    met = torch.cat(points)
    hits = torch.bincount(cells_of(contract(met), grid.resolution), minlength=grid.resolution**3)
    return SeenSurface(met, hits.float(), largest)
