"""Density and colour of a scene on a dense grid over contracted space."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from neural_sim.field.interpolation import CORNERS, corner_weights, gather_weighted, interpolate_for_training
from neural_sim.field.scene.space import Frame, cells_of, contract, expand

INITIAL = -5.0
"""Argument of softplus in a new grid, low enough that most light passes through the scene."""
GAIN = 2.0
"""Factor by which density learns faster than colour."""
AT_ONCE = 1 << 17
"""Number of vertices that are resampled at once."""
EMPTY = 1e-3
"""Largest fraction of light that an empty cell absorbs over the length of its edge."""


class SceneGrid:
    """A trilinear field over ``resolution``^3 cells of [-2, 2]^3.

    sigma = softplus(GAIN raw) per cell edge of contracted length; the colour is the sigmoid of three more channels.
    ``table`` has a row for each vertex; x varies slowest.
    """

    def __init__(self, resolution: int, table: Float[Tensor, "vertices 4"] | None = None) -> None:
        self.resolution = resolution
        if table is None:
            table = torch.zeros((resolution + 1) ** 3, 4)
            table[:, 0] = INITIAL / GAIN
        self.table = table
        side = resolution + 1
        self._steps = (CORNERS[:, 0] * side + CORNERS[:, 1]) * side + CORNERS[:, 2]
        self.occupied = torch.ones(resolution**3, dtype=torch.bool)

    @property
    def samples(self) -> int:
        """Number of samples on a ray, which are about a cell apart in the unit ball."""
        return round(0.75 * self.resolution)

    @property
    def edge(self) -> float:
        """Edge of a cell, in contracted length."""
        return 4.0 / self.resolution

    def corners(
        self, contracted: Float[Tensor, "samples 3"]
    ) -> tuple[Int[Tensor, "samples 8"], Float[Tensor, "samples 8"]]:
        """Return the table rows around points, and their weights."""
        local = (contracted + 2.0) / self.edge
        base = local.floor().clamp_(0, self.resolution - 1)
        weights = corner_weights(*(local - base).t().contiguous())
        side = self.resolution + 1
        x, y, z = base.int().t().contiguous()
        return ((x * side + y) * side + z)[:, None] + self._steps.int(), weights

    def raw(
        self, corners: Int[Tensor, "samples 8"], weights: Float[Tensor, "samples 8"]
    ) -> Float[Tensor, "samples 4"]:
        """Interpolate rows; differentiable in the table."""
        if self.table.requires_grad and torch.is_grad_enabled():
            return interpolate_for_training(self.table, corners, weights)
        return gather_weighted(self.table, corners, weights)

    def density(self, raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Return density, per contracted length, from the first channel."""
        return functional.softplus(GAIN * raw) / self.edge

    def in_occupied(self, contracted: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Tell whether points lie in occupied cells."""
        return self.occupied[cells_of(contracted, self.resolution)]

    def variation(self, vertices: Int[Tensor, "some"]) -> Float[Tensor, ""]:
        """Compute the total variation, at these vertices, of the fraction of light absorbed over a cell's edge.

        It is the mean norm of a vertex's differences from its next neighbours along the three axes. Among surfaces that
        explain the photographs equally well, the smoothest has the least.
        """
        side = self.resolution + 1
        last = len(self.table) - 1
        ends = [(vertices + step).clamp_max(last) for step in (side * side, side, 1)]
        absorbed = [
            -torch.expm1(-functional.softplus(GAIN * self.table[:, 0][at])) for at in (vertices, *ends)
        ]
        square = torch.stack([(end - absorbed[0]).square() for end in absorbed[1:]]).sum(0)
        return (square + 1e-6).sqrt().mean()

    @torch.no_grad()
    def absorbed(self) -> Float[Tensor, "cells"]:
        """Compute the largest fraction absorbed over a cell's edge at any of each cell's vertices."""
        absorbed = -torch.expm1(-functional.softplus(GAIN * self.table[:, 0]))
        side = self.resolution + 1
        return functional.max_pool3d(absorbed.view(1, 1, side, side, side), 2, 1).flatten()

    def mark(self) -> None:
        """Update the occupied cells: those with a vertex that absorbs more than ``EMPTY``."""
        self.occupied = self.absorbed() > EMPTY

    @torch.no_grad()
    def moved(self, old: Frame, new: Frame) -> SceneGrid:
        """Resample the field from the frame ``old`` onto a grid of the same resolution in the frame ``new``."""
        side = self.resolution + 1
        axis = torch.linspace(-2.0, 2.0, side)
        vertices = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3)
        rows = []
        for part in vertices.split(AT_ONCE):
            rows.append(self.raw(*self.corners(contract(old.of(new, expand(part))))))
        return SceneGrid(self.resolution, torch.cat(rows))

    @torch.no_grad()
    def refined(self) -> SceneGrid:
        """Resample the field onto twice as many cells per side, each of which absorbs as much as an old one did."""
        side, finer = self.resolution + 1, 2 * self.resolution + 1
        values = self.table.detach().view(side, side, side, 4).permute(3, 0, 1, 2)[None]
        table = functional.interpolate(values, (finer, finer, finer), mode="trilinear", align_corners=True)
        return SceneGrid(2 * self.resolution, table[0].permute(1, 2, 3, 0).reshape(-1, 4).contiguous())
