"""The occupied cells of a grid: their packed numbers, and the distance to the nearest one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

COARSENING = 4
"""Number of cells along the edge of a coarse cell; rays skip empty space by coarse cells."""
NOTHING = (
    "occupancy: no cell is occupied, want at least one (were all silhouettes empty, or all cells pruned?)"
)
FARTHEST = 16
"""Longest distance in coarse cells; longer ones are recorded as this one."""


@dataclass(frozen=True)
class Occupancy:
    """Cells of edge ``cell`` (object radii) from corner ``origin``.

    ``index`` is -1 in empty cells, and elsewhere the cell's number in x-major order. ``distance`` is, for every coarse
    cell of ``COARSENING``^3 cells, the Chebyshev distance in coarse cells to the nearest one with an occupied cell (0:
    itself), at most ``FARTHEST``.
    """

    origin: Float[Tensor, "3"]
    cell: float
    index: Int[Tensor, "nx ny nz"]
    distance: Int[Tensor, "cx cy cz"]

    @property
    def count(self) -> int:
        """The number of occupied cells."""
        return int(self.index.max()) + 1

    @property
    def occupied(self) -> Bool[Tensor, "nx ny nz"]:
        """True where a cell is occupied."""
        return self.index >= 0


def build_occupancy(occupied: Bool[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], cell: float) -> Occupancy:
    """Assign numbers to the occupied cells, and compute distances to them.

    Raises:
        ValueError: no cell is occupied.
    """
    if not bool(occupied.any()):
        raise ValueError(NOTHING)
    number = occupied.flatten().cumsum(0, dtype=torch.int32).view(occupied.shape) - 1
    index = torch.where(occupied, number, torch.full_like(number, -1))
    return Occupancy(origin, cell, index, _coarse_distance(occupied))


def _coarse_distance(occupied: Bool[Tensor, "nx ny nz"]) -> Int[Tensor, "cx cy cz"]:
    short = [-size % COARSENING for size in occupied.shape]
    padded = functional.pad(occupied.float(), (0, short[2], 0, short[1], 0, short[0]))
    reached = functional.max_pool3d(padded[None, None], COARSENING)
    distance = torch.full_like(reached, FARTHEST)
    for step in range(FARTHEST):
        distance = torch.where((reached > 0) & (distance > step), torch.full_like(distance, step), distance)
        reached = dilate(reached[0, 0])[None, None]
    return distance[0, 0].to(torch.int32)


def dilate(field: Float[Tensor, "nx ny nz"]) -> Float[Tensor, "nx ny nz"]:
    """Take the maximum over the 26 neighbours and the cell itself, one axis at a time."""
    values = field[None, None]
    for kernel, padding in (((3, 1, 1), (1, 0, 0)), ((1, 3, 1), (0, 1, 0)), ((1, 1, 3), (0, 0, 1))):
        values = functional.max_pool3d(values, kernel, 1, padding)
    return values[0, 0]


def subdivide(occupied: Bool[Tensor, "nx ny nz"]) -> Bool[Tensor, "mx my mz"]:
    """Divide each cell into eight of half the edge."""
    return occupied.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def crop(
    occupied: Bool[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], cell: float
) -> tuple[Bool[Tensor, "mx my mz"], Float[Tensor, "3"]]:
    """Cut away empty margins; return the smaller grid and its origin.

    Raises:
        ValueError: no cell is occupied.
    """
    where = occupied.nonzero()
    if not len(where):
        raise ValueError(NOTHING)
    low = where.min(0).values
    (x, y, z), (u, v, w) = torch.stack([low, where.max(0).values + 1]).tolist()
    inside = occupied[x:u, y:v, z:w].contiguous()
    return inside, origin + low.to(origin.dtype) * cell


def vertices(
    occupancy: Occupancy, corners: Int[Tensor, "8 3"]
) -> tuple[Int[Tensor, "cells 8"], Int[Tensor, "vertices 3"]]:
    """Return packed vertex numbers of every occupied cell's corners, and every vertex's grid coordinates."""
    where = occupancy.occupied.nonzero()
    shape = torch.tensor(occupancy.index.shape, device=where.device) + 1
    coordinates = where[:, None, :] + corners.to(where.device)
    flat = (coordinates[..., 0] * shape[1] + coordinates[..., 1]) * shape[2] + coordinates[..., 2]
    used = torch.zeros(int(shape.prod()), dtype=torch.bool, device=where.device)
    used[flat.flatten()] = True
    number = used.cumsum(0, dtype=torch.int32) - 1
    kept = used.nonzero()[:, 0]
    grid = torch.stack([kept // (shape[1] * shape[2]), kept // shape[2] % shape[1], kept % shape[2]], -1)
    return number[flat], grid
