"""The training rays of a set of views: those that can hit the object, shuffled, with their samples kept ready."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.base import PackedSamples
from neural_sim.field.grid import GridField
from neural_sim.types import PosedViews, Rays

CHUNK = 1 << 16


@dataclass(frozen=True)
class RayPool:
    """Rays and their pixels (premultiplied RGBA). ``phase`` shifts each ray's lattice, so that rays share no depths.

    ``samples`` and ``cells`` are the packed samples of all rays in a grid field, absent for other fields.
    """

    rays: Rays
    pixels: Float[Tensor, "rays 4"]
    phase: Float[Tensor, "rays"]
    samples: PackedSamples | None = None
    cells: Int[Tensor, "samples"] | None = None

    def __len__(self) -> int:
        return self.pixels.shape[0]

    def slice(self, first: int, last: int) -> RayPool:
        """Rays first to last (exclusive); consecutive rays of a shuffled pool are a random batch."""
        pick = slice(first, last)
        rays = Rays(self.rays.origins[pick], self.rays.directions[pick])
        part = RayPool(rays, self.pixels[pick], self.phase[pick])
        if self.samples is None or self.cells is None:
            return part
        starts = self.samples.starts[first : last + 1]
        begin, end = int(starts[0]), int(starts[-1])
        packed = PackedSamples(
            self.samples.ray[begin:end] - first,
            self.samples.distance[begin:end],
            self.samples.width[begin:end],
            starts - begin,
        )
        return replace(part, samples=packed, cells=self.cells[begin:end])

    def select(self, index: Int[Tensor, "some"]) -> RayPool:
        """Other rays or another order; samples are not carried over."""
        rays = Rays(self.rays.origins[index], self.rays.directions[index])
        return RayPool(rays, self.pixels[index], self.phase[index])


def build_pool(views: PosedViews, generator: torch.Generator) -> RayPool:
    """All rays of ``views`` in random order."""
    bundle = cameras.rays(views.camera, views.camera_to_world)
    pixels = views.images.reshape(-1, 4)
    pixels = torch.cat([pixels[:, :3] * pixels[:, 3:], pixels[:, 3:]], -1)
    phase = torch.rand(len(pixels), generator=generator, device=generator.device).to(pixels)
    pool = RayPool(Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3)), pixels, phase)
    order = torch.randperm(len(pixels), generator=generator, device=generator.device)
    return pool.select(order.to(pixels.device))


def march_pool(pool: RayPool, field: GridField, termination: float) -> RayPool:
    """The pool's rays that have samples in the field's occupied cells, with those samples."""
    origins, directions = pool.rays.origins, pool.rays.directions
    parts = [
        field.sample_cells(Rays(o, d), termination, phase)
        for o, d, phase in zip(
            origins.split(CHUNK), directions.split(CHUNK), pool.phase.split(CHUNK), strict=True
        )
    ]
    counts = torch.cat([packed.starts.diff() for packed, _ in parts])
    hit = (counts > 0).nonzero()[:, 0]
    starts = torch.nn.functional.pad(counts[hit].cumsum(0), (1, 0))
    samples = PackedSamples(
        torch.repeat_interleave(torch.arange(len(hit), device=hit.device), counts[hit]),
        torch.cat([packed.distance for packed, _ in parts]),
        torch.cat([packed.width for packed, _ in parts]),
        starts,
    )
    return replace(pool.select(hit), samples=samples, cells=torch.cat([cells for _, cells in parts]))
