"""Fit a grid field coarse to fine, with cells only where a silhouette or a learned density requires them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import scipy.ndimage
import torch
from annotated_types import Ge, Lt
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import override

from neural_sim.field.grid import GridField
from neural_sim.field.hull import COARSEST, Resolution, pixels_across, visual_hull
from neural_sim.field.objective import Fitting, RayBlocks
from neural_sim.field.occupancy import crop
from neural_sim.field.pool import RayPool, build_pool
from neural_sim.field.quadrature import PackedSamples, composite, render_weights, sample_points
from neural_sim.field.scores import Rendering
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import PosedViews

BelowOne = Annotated[float, Ge(0), Lt(1)]
LARGE = 0.05
"""Smallest connected part that is kept in a field of photographs, relative to the largest part. Poses are inexact, and
where few cameras look, the field contains floaters: matter in the air that explains single photographs."""
BRIDGED = 2
"""Number of cells by which parts are dilated before they are labelled, because a surface may have gaps."""
SPREAD = 0.25
"""Factor on ``prune_weight`` for photographs. Inexact cameras and blur spread a surface over several cells, each of
which contributes less; with the full weight, surfaces had holes."""
BATCHES_PER_BLOCK = 8
"""Number of batches whose samples are chosen at once, because each choice has a fixed cost."""


@validated
class GridFitting(Fitting):
    """Fits coarse to fine, first in the visual hull's cells.

    At each of ``refine_steps``, empty cells are dropped and the edges of the others are halved; at ``prune_steps``,
    empty cells are dropped. ``resolution`` is the final number of cells along the unit sphere's diameter; with n
    refinements, the first is ``resolution`` / 2^n. A cell stays if it or a neighbour holds a sample that contributes
    more than ``prune_weight`` (for photographs, ``SPREAD`` times that) to one of ``prune_rays`` pixels. Samples whose
    transmittance is below ``termination`` are dropped.
    """

    field: GridField

    def __init__(
        self,
        field: GridField,
        resolution: Resolution = 256,
        refine_steps: tuple[PositiveInt, ...] = (100, 300),
        prune_steps: tuple[PositiveInt, ...] = (),
        prune_weight: BelowOne = 0.2,
        prune_rays: PositiveInt = 131_072,
        batch_rays: PositiveInt = 4096,
        learning_rate: Positive = 0.2,
        head_learning_rate: Positive = 0.01,
        termination: BelowOne = 1e-3,
    ) -> None:
        super().__init__(field, batch_rays)
        if resolution >> len(refine_steps) < COARSEST:
            raise ValueError(
                f"GridFitting.resolution: want at least {COARSEST} after halving it {len(refine_steps)} times, "
                f"got {resolution}"
            )
        self.resolution = resolution
        self.refine_steps, self.prune_steps = tuple(refine_steps), tuple(prune_steps)
        self.prune_weight, self.prune_rays = prune_weight, prune_rays
        self.learning_rate, self.head_learning_rate = learning_rate, head_learning_rate
        self.termination = termination
        self._ready: list[tuple[RayPool, PackedSamples, Tensor]] = []
        self._photographs = False

    @override
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        occupied, origin, cell = visual_hull(views, self.resolution >> len(self.refine_steps))
        occupied, origin = crop(occupied, origin, cell)
        self.field.reset(occupied, origin, cell)
        # A hull cell reaches at most one diagonal beyond the silhouette: its centre is within half a diagonal.
        border = pixels_across(views, math.sqrt(3.0) * cell)
        self._blocks = RayBlocks(build_pool(views, border, generator))
        self._ready = []
        self._photographs = views.known is not None

    def next_batch(self) -> tuple[RayPool, PackedSamples, Int[Tensor, "samples"]]:
        """Return the next rays, with their samples and the cells of these samples."""
        if not self._ready:
            block = self._blocks.draw(self.batch_rays * BATCHES_PER_BLOCK)
            self._ready = self._batches(block, self.batch_rays)[::-1]
        return self._ready.pop()

    @override
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        rays, samples, cells = self.next_batch()
        positions, directions = sample_points(rays.rays, samples)
        sigma, rgb = self.field.decode(self.field.raw(positions, cells), directions)
        return [composite(sigma, rgb, samples)], rays.pixels

    def _batches(
        self, block: RayPool, size: int
    ) -> list[tuple[RayPool, PackedSamples, Int[Tensor, "samples"]]]:
        samples, cells = self.field.sample_cells(block.rays, self.termination, block.phase)
        batches = []
        rays = [*range(0, len(block), size), len(block)]
        places = [*samples.starts[:-1:size].tolist(), len(samples)]
        for (first, begin), (last, end) in pairwise(zip(rays, places, strict=True)):
            part = samples.of_rays(first, last, begin, end)
            batches.append((block.select(slice(first, last)), part, cells[begin:end]))
        return batches

    @override
    def advance(self, step: int) -> bool:
        refine = step in self.refine_steps
        if not refine and step not in self.prune_steps:
            return False
        seen = self._seen_cells()
        if self._photographs:
            seen = seen & _large_parts(self.field.occupied, seen)
        self.field.keep(seen, refine)
        self._ready = []
        return True

    @override
    def state(self) -> dict[str, Any] | None:
        # No fit resumes within a block: its samples were chosen with the densities at its first step.
        return None if self._ready else {"field": self.field.state_dict(), "next": self._blocks.next}

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        self.field.load_state_dict(state["field"])
        self._blocks.next = state["next"]

    @torch.no_grad()
    def _seen_cells(self) -> Bool[Tensor, "cells"]:
        """Find which of the occupied cells, in packed order, some pixel shows."""
        largest = self.field.table.new_zeros(self.field.occupancy.count)
        size = self.batch_rays * BATCHES_PER_BLOCK
        for _ in range(math.ceil(self.prune_rays / size)):
            block = self._blocks.draw(size)
            for rays, samples, cells in self._batches(block, size):
                positions, _ = sample_points(rays.rays, samples)
                weights = render_weights(self.field.density(self.field.raw(positions, cells)), samples)
                largest.scatter_reduce_(0, cells.long(), weights, "amax")
        return largest > (SPREAD if self._photographs else 1.0) * self.prune_weight

    @override
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        groups = [([self.field.table], self.learning_rate)]
        if self.field.head is not None:
            groups.append((list(self.field.head.parameters()), self.head_learning_rate))
        return groups


def _large_parts(occupied: Bool[Tensor, "nx ny nz"], seen: Bool[Tensor, "cells"]) -> Bool[Tensor, "cells"]:
    """Find the seen cells in connected parts of at least ``LARGE`` times the largest; smaller parts are floaters."""
    grid = torch.zeros_like(occupied)
    grid[occupied] = seen
    parts = np.zeros(tuple(grid.shape), dtype=np.int64)
    full = np.ones((3, 3, 3))
    scipy.ndimage.label(scipy.ndimage.binary_dilation(grid.cpu().numpy(), full, BRIDGED), full, output=parts)
    label = torch.from_numpy(parts).to(occupied.device)[occupied]
    sizes = torch.bincount(label[seen], minlength=1)
    return seen & (sizes >= LARGE * float(sizes.max()))[label.clamp_max(len(sizes) - 1)]
