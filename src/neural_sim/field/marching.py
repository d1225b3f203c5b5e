"""Sample rays in occupied cells at uniform steps on a fixed lattice, skipping empty space and terminated rays.

The lattice of a ray is t_k = (k + phase) step from the ray's origin, whatever is skipped: skipping empty space
changes no sample, and the same ray always has the same distances. Each coordinate is a contiguous array of its own,
which on a CPU is several times faster than arrays of points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.devices import at_once
from neural_sim.field.occupancy import COARSENING, Occupancy
from neural_sim.field.quadrature import PackedSamples, Span
from neural_sim.types import Rays

SHORTEST, LONGEST = 8, 64
"""Smallest and largest number of lattice steps that a ray takes at once near an occupied coarse cell; powers of two."""
POINTS = 131_072
"""Number of points up to which the waves of few rays are lengthened: in smaller ones, the cost of calls dominates."""

Axes = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Wave:
    """The next ``length`` lattice steps of n rays, of which k lie in occupied cells.

    ``ray`` holds the rays' indices; ``row`` is each sample's index in ``ray`` and ``place`` its index among the n x
    length steps, both in increasing order; ``count`` is the number of each ray's samples. ``fraction`` is the position
    inside the cell, x, y and z in [0, 1].
    """

    length: int
    ray: Int[Tensor, "n"]
    count: Int[Tensor, "n"]
    row: Int[Tensor, "k"]
    place: Int[Tensor, "k"]
    distance: Float[Tensor, "k"]
    cell: Int[Tensor, "k"]
    fraction: Axes


Visitor = Callable[[Wave], Bool[Tensor, "n"]]
"""Receives a wave, and returns which of its rays continue."""


@dataclass(frozen=True)
class _Walk:
    """Rays in cell units: an array for each coordinate, the last lattice step in the grid, and the lattice's phase."""

    origin: Axes
    direction: Axes
    last: Float[Tensor, "n"]
    phase: Float[Tensor, "n"]

    def select(self, index: Int[Tensor, "m"]) -> _Walk:
        x, y, z, u, v, w, last, phase = (
            part.index_select(0, index) for part in (*self.origin, *self.direction, self.last, self.phase)
        )
        return _Walk((x, y, z), (u, v, w), last, phase)

    def at(self, travelled: Float[Tensor, "n *steps"]) -> Axes:
        """Return positions after travelling the given distances, in cells."""
        shape = (-1,) + (1,) * (travelled.ndim - 1)
        x, y, z = (
            torch.addcmul(start.view(shape), along.view(shape), travelled)
            for start, along in zip(self.origin, self.direction, strict=True)
        )
        return x, y, z


def march(
    rays: Rays,
    occupancy: Occupancy,
    step: float,
    phase: Float[Tensor, "rays"] | float,
    visit: Visitor,
    span: Span | None = None,
    skip_empty: bool = True,
) -> None:
    """Walk rays of shape (rays, 3) through the grid and pass ``visit`` every wave that may meet occupied cells.

    ``step`` is in object radii, ``phase`` in [0, 1) steps. A ray's waves come in order of distance. ``span`` may give
    the distances between which the occupied cells of each ray lie. Without ``skip_empty``, a ray takes every step in
    the grid's box.

    Raises:
        ValueError: a ray starts so far away that its dtype cannot tell one lattice step from the next (float32: 2^22
            steps).
    """
    unit = step / occupancy.cell
    ray, ahead, every = _enter(rays, occupancy, step, phase, span)
    nearest = occupancy.distance.flatten() if skip_empty else torch.zeros_like(occupancy.distance).flatten()
    points = at_once(POINTS, ray.device)
    while len(ray):
        walk = every.select(ray)
        away, following = _leap(walk, ahead, occupancy, nearest, unit)
        length = SHORTEST
        while 2 * length * len(ray) <= points and length < LONGEST:
            length *= 2
        # A ray joins the wave a little before an occupied coarse cell, if the wave is long enough to cross the gap.
        there = (away <= length // (4 * COARSENING)).nonzero()[:, 0]
        going = following <= walk.last
        if len(there):
            # Most rays arrive together, so a copy of some of them is seldom needed.
            whole = len(there) == len(ray)
            arrived = walk if whole else walk.select(there)
            number, first = (
                (ray, ahead) if whole else (ray.index_select(0, there), ahead.index_select(0, there))
            )
            alive = visit(_wave(number, first, length, arrived, occupancy, unit))
            beyond = first + length
            following.index_copy_(0, there, beyond)
            going.index_copy_(0, there, alive & (beyond <= arrived.last))
        index = going.nonzero()[:, 0]
        ray, ahead = ray.index_select(0, index), following.index_select(0, index)


def _wave(ray: Tensor, first: Tensor, length: int, walk: _Walk, occupancy: Occupancy, unit: float) -> Wave:
    lattice = first[:, None] + torch.arange(length, dtype=first.dtype, device=first.device)
    travelled = (lattice + walk.phase[:, None]) * unit
    local = walk.at(travelled)
    cell = occupancy.index.flatten().index_select(0, _flat(local, occupancy.index.shape).flatten())
    kept = (cell.view_as(lattice) >= 0) & (lattice <= walk.last[:, None])
    place = kept.flatten().nonzero()[:, 0]
    x, y, z = (
        _fraction(axis.flatten().index_select(0, place), size)
        for axis, size in zip(local, occupancy.index.shape, strict=True)
    )
    distance = travelled.flatten().index_select(0, place) * occupancy.cell
    row = place >> (length.bit_length() - 1)
    return Wave(length, ray, kept.sum(1), row, place, distance, cell.index_select(0, place), (x, y, z))


def _fraction(local: Float[Tensor, "k"], size: int) -> Float[Tensor, "k"]:
    """Return the position inside the cell that ``_flat`` finds."""
    return local - local.clamp(0, size - 1).floor()


def _flat(local: Axes, shape: torch.Size) -> Int[Tensor, "*n"]:
    """Return the flat index of the grid's cell at each position; beyond the grid, of the nearest cell."""
    x, y, z = (axis.clamp(0, size - 1).to(torch.int32) for axis, size in zip(local, shape, strict=True))
    return torch.add(z, torch.add(y, x, alpha=shape[1]), alpha=shape[2])


def lookup(local: Float[Tensor, "*samples 3"], occupancy: Occupancy) -> Int[Tensor, "*samples"]:
    """Find the occupied cell at positions in cell units from the grid's origin: its number, or -1."""
    shape = occupancy.index.shape
    x, y, z = (axis.contiguous() for axis in local.unbind(-1))
    flat = _flat((x, y, z), shape)
    cells = occupancy.index.flatten().index_select(0, flat.flatten()).view(flat.shape)
    outside = torch.zeros_like(cells, dtype=torch.bool)
    for axis, size in zip((x, y, z), shape, strict=True):
        outside |= (axis < 0) | (axis >= size)
    return cells.masked_fill(outside, -1)


def _enter(
    rays: Rays, occupancy: Occupancy, step: float, phase: Float[Tensor, "rays"] | float, span: Span | None
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"], _Walk]:
    """Return the indices of the rays that meet the grid's box, their first lattice steps inside, and all the rays."""
    origin = ((rays.origins - occupancy.origin) / occupancy.cell).t().contiguous()
    # A direction component of zero would divide by zero; a tiny one gives the same span.
    slope = rays.directions.t().contiguous()
    slope = torch.where(slope.abs() < 1e-9, torch.full_like(slope, 1e-9), slope)
    beyond = torch.stack([size - axis for axis, size in zip(origin, occupancy.index.shape, strict=True)])
    to_low, to_high = -origin / slope, beyond / slope
    near, far = torch.minimum(to_low, to_high).amax(0).clamp_min(0.0), torch.maximum(to_low, to_high).amin(0)
    unit = step / occupancy.cell
    if span is not None:
        near, far = (
            torch.maximum(near, span.near / occupancy.cell),
            torch.minimum(far, span.far / occupancy.cell),
        )
    phases = phase.to(origin) if isinstance(phase, Tensor) else torch.full_like(near, phase)
    first, last = (near / unit - phases).ceil().clamp_min(0.0), (far / unit - phases).floor()
    ray = (first <= last).nonzero()[:, 0]
    limit = 0.5 / torch.finfo(origin.dtype).eps
    farthest = float(last.index_select(0, ray).amax()) if len(ray) else 0.0
    if farthest > limit:
        raise ValueError(
            f"march: the grid lies {farthest:.3g} steps of {step:.3g} from a ray's origin, but {origin.dtype} counts "
            f"only to {limit:.3g}; bring the camera closer"
        )
    x, y, z = origin.unbind(0)
    u, v, w = slope.unbind(0)
    return ray, first.index_select(0, ray), _Walk((x, y, z), (u, v, w), last, phases)


def _leap(
    walk: _Walk, ahead: Float[Tensor, "n"], occupancy: Occupancy, nearest: Int[Tensor, "coarse"], unit: float
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Return distances to the nearest occupied coarse cell, and the first lattice steps beyond known empty space.

    A ray whose coarse cell is d > 0 cells from the nearest occupied one may jump to the exit of the cube that extends
    d - 1 coarse cells beyond its own on every side.
    """
    travelled = (ahead + walk.phase) * unit
    local = tuple(axis / COARSENING for axis in walk.at(travelled))
    away = nearest.index_select(0, _flat((local[0], local[1], local[2]), occupancy.distance.shape))
    reach = away.to(travelled.dtype) - 0.5
    exits = []
    for axis, along in zip(local, walk.direction, strict=True):
        slowness = along.reciprocal()
        exits.append(torch.addcmul((axis.floor() + 0.5 - axis) * slowness, reach, slowness.abs()))
    free = torch.minimum(torch.minimum(exits[0], exits[1]), exits[2]) * COARSENING
    following = ((travelled + free) / unit - walk.phase).ceil()
    return away, torch.maximum(following, ahead + 1.0)


class SampleCollector:
    """Gathers the occupied samples of waves and sorts them into packed order by counting."""

    def __init__(self, rays: int, like: Float[Tensor, "*any"]) -> None:
        number = torch.zeros(0, dtype=torch.int64, device=like.device)
        self._count = torch.zeros(rays, dtype=torch.int64, device=like.device)
        # One empty part, so that rays that all miss need no special case.
        self._parts = [(number, number, like.new_zeros(0), number.to(torch.int32))]

    def add(self, wave: Wave, kept: Bool[Tensor, "k"] | None = None) -> None:
        """Add the samples of a wave, or only those that are ``kept``."""
        row, distance, cell, count = wave.row, wave.distance, wave.cell, wave.count
        if kept is not None:
            index = kept.nonzero()[:, 0]
            row, distance, cell = (part.index_select(0, index) for part in (row, distance, cell))
            # Differences of a running count; ``bincount`` would make the host wait for the device.
            ends = torch.nn.functional.pad(kept.cumsum(0), (1, 0)).index_select(0, wave.count.cumsum(0))
            count = torch.diff(ends, prepend=ends.new_zeros(1))
        before = self._count.index_select(0, wave.ray)
        # Rows come in order, so a sample's rank is its number minus that of its row's first sample.
        first = before - (count.cumsum(0) - count)
        order = torch.arange(len(row), device=row.device) + first.index_select(0, row)
        self._parts.append((wave.ray.index_select(0, row), order, distance, cell))
        self._count.index_copy_(0, wave.ray, before + count)

    def finish(self, width: float) -> tuple[PackedSamples, Int[Tensor, "samples"]]:
        """Return all samples in packed order, each representing a length ``width`` of its ray, and their cells."""
        starts = torch.nn.functional.pad(self._count.cumsum(0), (1, 0))
        ray, order, distance, cell = (torch.cat(parts) for parts in zip(*self._parts, strict=True))
        place = starts.index_select(0, ray) + order
        packed = [torch.empty_like(x).index_copy_(0, place, x) for x in (distance, cell)]
        rays = torch.arange(len(self._count), device=ray.device).repeat_interleave(
            self._count, output_size=len(ray)
        )
        widths = torch.full_like(packed[0], width)
        return PackedSamples(rays, packed[0], widths, starts), packed[1]
