"""Samples where rays meet occupied cells: uniform steps on a fixed lattice, empty space skipped, rays that end dropped.

The lattice of a ray is t_k = (k + phase) step from the ray's origin, whatever was skipped; so leaving empty space out
changes no sample, and the same ray always has the same distances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.field.base import PackedSamples
from neural_sim.field.occupancy import COARSENING, Occupancy
from neural_sim.types import Rays

WAVE = 8
"""Lattice steps taken at once by each ray that has reached a coarse occupied cell."""

Visitor = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Sees (ray [n], distance [n, WAVE], cell [n, WAVE] or -1, position [n, WAVE, 3]); returns which rays go on [n]."""


@dataclass(frozen=True)
class _Front:
    """Rays still under way: number, next lattice step, last step inside the grid, and the ray itself in cells."""

    ray: Int[Tensor, "n"]
    step: Float[Tensor, "n"]
    last: Float[Tensor, "n"]
    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    phase: Float[Tensor, "n"]

    def keep(self, mask: Bool[Tensor, "n"], step: Float[Tensor, "n"]) -> _Front:
        index = mask.nonzero()[:, 0]
        pick = [
            x.index_select(0, index)
            for x in (self.ray, step, self.last, self.origin, self.direction, self.phase)
        ]
        return _Front(*pick)


def march(
    rays: Rays, occupancy: Occupancy, step: float, phase: Float[Tensor, "rays"] | float, visit: Visitor
) -> None:
    """Walk rays of shape (rays, 3) through the grid and show ``visit`` every wave that may hold occupied cells.

    ``step`` in object radii, ``phase`` in [0, 1) steps. A ray's waves come in order of distance. Raises ValueError
    where a ray starts so far away that its arithmetic cannot tell one lattice step from the next (float32: 2^22 steps).
    """
    front = _enter(rays, occupancy, step, phase)
    distance = occupancy.distance.flatten()
    offsets = torch.arange(WAVE, dtype=rays.origins.dtype, device=rays.origins.device)
    while len(front.ray):
        front = _skip_empty(front, occupancy, distance, step / occupancy.cell)
        if not len(front.ray):
            return
        lattice = front.step[:, None] + offsets
        distances = (lattice + front.phase[:, None]) * step
        local = (
            front.origin[:, None, :] + front.direction[:, None, :] * (distances / occupancy.cell)[..., None]
        )
        cell = lookup(local, occupancy)
        cell = torch.where(lattice <= front.last[:, None], cell, -1)
        alive = visit(front.ray, distances, cell, local)
        front = front.keep(alive & (front.step + WAVE <= front.last), front.step + WAVE)


def lookup(local: Float[Tensor, "*samples 3"], occupancy: Occupancy) -> Int[Tensor, "*samples"]:
    """Number of the occupied cell at positions in cell units from the grid's origin, or -1."""
    shape = occupancy.index.shape
    x, y, z = local.floor().to(torch.int32).unbind(-1)
    inside = (x >= 0) & (x < shape[0]) & (y >= 0) & (y < shape[1]) & (z >= 0) & (z < shape[2])
    flat = (x * shape[1] + y) * shape[2] + z
    flat = torch.where(inside, flat, torch.zeros_like(flat))
    found = occupancy.index.flatten().index_select(0, flat.flatten()).view(flat.shape)
    return torch.where(inside, found, torch.full_like(found, -1))


def _enter(rays: Rays, occupancy: Occupancy, step: float, phase: Float[Tensor, "rays"] | float) -> _Front:
    """Rays that meet the grid's box, at their first lattice step inside."""
    origin = (rays.origins - occupancy.origin) / occupancy.cell
    # A direction component of exactly zero would divide by zero; the smallest slope has the same span.
    slope = torch.where(rays.directions.abs() < 1e-9, torch.full_like(rays.directions, 1e-9), rays.directions)
    size = torch.tensor(occupancy.index.shape, dtype=origin.dtype, device=origin.device)
    to_low, to_high = -origin / slope, (size - origin) / slope
    unit = occupancy.cell / step
    near = torch.minimum(to_low, to_high).amax(-1).clamp_min(0.0) * unit
    far = torch.maximum(to_low, to_high).amin(-1) * unit
    phases = torch.as_tensor(phase, dtype=origin.dtype, device=origin.device).expand(len(origin))
    first, last = (near - phases).ceil().clamp_min(0.0), (far - phases).floor()
    met, limit = last[first <= last], 0.5 / torch.finfo(origin.dtype).eps
    farthest = float(met.amax()) if len(met) else 0.0
    if farthest > limit:
        raise ValueError(
            f"march: the grid lies {farthest:.3g} steps of {step:.3g} from a ray's origin, {origin.dtype} counts to "
            f"{limit:.3g}; bring the camera closer"
        )
    number = torch.arange(len(origin), device=origin.device)
    return _Front(number, first, last, origin, slope, phases).keep(first <= last, first)


def _skip_empty(front: _Front, occupancy: Occupancy, distance: Int[Tensor, "coarse"], unit: float) -> _Front:
    """Move every ray to its next lattice step in an occupied coarse cell; drop the rays that leave the grid.

    A ray whose coarse cell is d > 0 cells from the nearest occupied one may go on to the exit of the cube of
    d - 1 cells around its own.
    """
    coarse = torch.tensor(occupancy.distance.shape, dtype=torch.int32, device=distance.device)
    arrived: list[_Front] = []
    while len(front.ray):
        travelled = (front.step + front.phase) * unit
        local = (front.origin + front.direction * travelled[:, None]) / COARSENING
        own = local.floor()
        x, y, z = torch.minimum(own.to(torch.int32).clamp_min(0), coarse - 1).unbind(-1)
        away = distance.index_select(0, (x * coarse[1] + y) * coarse[2] + z)
        there = away == 0
        if bool(there.any()):
            arrived.append(front.keep(there, front.step))
        reach = (away - 1).to(local.dtype)[:, None]
        wall = torch.where(front.direction > 0, own + 1.0 + reach, own - reach)
        ahead = ((wall - local) / front.direction).amin(-1) * COARSENING
        step = torch.maximum(((travelled + ahead) / unit - front.phase).ceil(), front.step + 1.0)
        front = front.keep(~there & (step <= front.last), step)
    if not arrived:
        return front
    return _Front(*(torch.cat(parts) for parts in zip(*(_fields(f) for f in arrived), strict=True)))


def _fields(front: _Front) -> tuple[Tensor, ...]:
    return front.ray, front.step, front.last, front.origin, front.direction, front.phase


class SampleCollector:
    """Gathers the occupied samples of waves and sorts them into packed order by counting."""

    def __init__(self, rays: int, like: Float[Tensor, "*any"]) -> None:
        number = torch.zeros(0, dtype=torch.int64, device=like.device)
        self._count = torch.zeros(rays, dtype=torch.int64, device=like.device)
        # One empty part, so that rays which all miss need no special case.
        self._parts = [(number, number, like.new_zeros(0), number.to(torch.int32))]

    def add(
        self, ray: Int[Tensor, "n"], distance: Float[Tensor, "n wave"], cell: Int[Tensor, "n wave"]
    ) -> None:
        """Keep the samples whose ``cell`` is not -1."""
        kept = cell >= 0
        rank = kept.cumsum(1)
        before = self._count.index_select(0, ray)
        where = kept.flatten().nonzero()[:, 0]
        row = where // cell.shape[1]
        order = (rank - 1 + before[:, None]).flatten().index_select(0, where)
        self._parts.append(
            (ray.index_select(0, row), order, distance.flatten()[where], cell.flatten()[where])
        )
        self._count.index_copy_(0, ray, before + rank[:, -1])

    def finish(self, width: float) -> tuple[PackedSamples, Int[Tensor, "samples"]]:
        """All samples in packed order, each standing for ``width`` of its ray, and their cells."""
        starts = torch.nn.functional.pad(self._count.cumsum(0), (1, 0))
        total = int(starts[-1])
        ray, order, distance, cell = (torch.cat(parts) for parts in zip(*self._parts, strict=True))
        place = starts.index_select(0, ray) + order
        packed = [torch.empty(total, dtype=x.dtype, device=x.device) for x in (ray, distance, cell)]
        for target, source in zip(packed, (ray, distance, cell), strict=True):
            target[place] = source
        widths = torch.full_like(packed[1], width)
        return PackedSamples(packed[0], packed[1], widths, starts), packed[2]
