"""How each kind of field is fitted: which rays make a batch, what is rendered, when the field's structure changes."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.base import RadianceField
from neural_sim.field.grid import GridField
from neural_sim.field.hull import visual_hull
from neural_sim.field.occupancy import crop, dilate
from neural_sim.field.pool import RayPool, build_pool, march_pool
from neural_sim.field.quadrature import composite, render_weights
from neural_sim.field.rendering import sample_points
from neural_sim.types import PosedViews

logger = logging.getLogger(__name__)

Rendering = tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]


def expected_error(rendering: Rendering, pixels: Float[Tensor, "rays 4"]) -> Float[Tensor, ""]:
    """Mean square colour error over a background drawn uniformly in [0, 1], in closed form.

    With d the error of premultiplied colour, a that of opacity and b the background, the pixel's error is d - a b;
    E b = 1/2 and E b^2 = 1/3. ``pixels`` are premultiplied RGBA.
    """
    colour = rendering[0] - pixels[:, :3]
    opacity = (rendering[1] - pixels[:, 3])[:, None]
    return (colour.square() - colour * opacity + opacity.square() / 3.0).mean()


class Fitting(ABC):
    """One field with its training rays. ``start`` before the first step, ``advance`` after each."""

    def __init__(self, field: RadianceField, batch_rays: int) -> None:
        if batch_rays < 1:
            raise ValueError(f"fitting: batch_rays must be at least 1, got {batch_rays}")
        self.field = field
        self.batch_rays = batch_rays
        self.pool: RayPool | None = None
        self._next = 0

    @abstractmethod
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        """Prepare field and rays for these views."""

    @abstractmethod
    def render(self, batch: RayPool) -> list[Rendering]:
        """All renderings of the batch that the loss compares with its pixels."""

    @abstractmethod
    def advance(self, step: int) -> bool:
        """Called after ``step`` steps; says whether the field's parameters were replaced."""

    @abstractmethod
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameter groups with their initial learning rates."""

    def batch(self) -> RayPool:
        """The next rays of the shuffled pool, from its beginning again when it is used up."""
        if self.pool is None:
            raise ValueError("fitting: batch was asked for before start")
        if self._next + self.batch_rays > len(self.pool):
            self._next = 0
        first, self._next = self._next, self._next + self.batch_rays
        return self.pool.slice(first, min(self._next, len(self.pool)))


class GridFitting(Fitting):
    """Coarse to fine: the visual hull's cells first; after each of ``refine_steps`` empty cells go, the rest halve.

    ``resolution`` is the final number of cells along the unit sphere's diameter; with n refinements the first is
    ``resolution`` / 2^n. ``prune_steps`` drop cells without halving. A cell stays when a sample in it or in a
    neighbour contributes more than ``prune_weight`` to some of ``prune_rays`` pixels. ``termination`` is the
    transmittance behind which training samples are dropped when samples are chosen anew.
    """

    field: GridField

    def __init__(
        self,
        field: GridField,
        resolution: int = 256,
        refine_steps: tuple[int, ...] = (60, 200),
        prune_steps: tuple[int, ...] = (),
        prune_weight: float = 0.01,
        prune_rays: int = 200_000,
        batch_rays: int = 4096,
        learning_rate: float = 0.1,
        head_learning_rate: float = 0.01,
        termination: float = 1e-3,
    ) -> None:
        super().__init__(field, batch_rays)
        if prune_rays < 1 or not 0.0 <= prune_weight < 1.0:
            raise ValueError(
                f"GridFitting: want prune_rays >= 1 and prune_weight in [0, 1), got {prune_rays} and {prune_weight}"
            )
        self.resolution, self.refine_steps, self.prune_steps = resolution, refine_steps, prune_steps
        self.prune_weight, self.prune_rays = prune_weight, prune_rays
        self.learning_rate, self.head_learning_rate = learning_rate, head_learning_rate
        self.termination = termination

    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        occupied, origin, cell = visual_hull(views, self.resolution >> len(self.refine_steps))
        occupied, origin = crop(occupied, origin, cell)
        self.field.reset(occupied, origin, cell)
        everything = build_pool(views, generator)
        self.pool = march_pool(everything, self.field, 0.0)
        logger.debug("%d of %d rays can meet the object", len(self.pool), len(everything))

    def render(self, batch: RayPool) -> list[Rendering]:
        if batch.samples is None:
            raise ValueError("GridFitting.render: the batch carries no samples")
        positions, directions = sample_points(batch.rays, batch.samples)
        sigma, rgb = self.field.decode(self.field.raw(positions, batch.cells), directions)
        return [composite(sigma, rgb, batch.samples)]

    def advance(self, step: int) -> bool:
        refine = step in self.refine_steps
        if not refine and step not in self.prune_steps:
            return False
        if self.pool is None:
            raise ValueError("GridFitting.advance: called before start")
        self.field.keep(self._seen_cells(self.pool), refine)
        self.pool = march_pool(self.pool, self.field, self.termination)
        self._next = 0
        return True

    @torch.no_grad()
    def _seen_cells(self, pool: RayPool) -> Tensor:
        """Occupied cells (in packed order) that show in some pixel, or whose neighbour does."""
        largest = self.field.table.new_zeros(self.field.occupancy.count)
        for first in range(0, min(self.prune_rays, len(pool)), 1 << 14):
            batch = pool.slice(first, min(first + (1 << 14), len(pool)))
            if batch.samples is None or batch.cells is None:
                raise ValueError("GridFitting: the pool carries no samples")
            positions, directions = sample_points(batch.rays, batch.samples)
            sigma, _ = self.field.decode(self.field.raw(positions, batch.cells), directions)
            weights = render_weights(sigma, batch.samples)
            largest.scatter_reduce_(0, batch.cells.long(), weights, "amax")
        occupied = self.field.occupied
        seen = torch.zeros(occupied.shape, dtype=largest.dtype, device=largest.device)
        seen[occupied] = (largest > self.prune_weight).to(largest.dtype)
        return dilate(seen)[occupied] > 0

    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        groups = [([self.field.table], self.learning_rate)]
        if self.field.head is not None:
            groups.append((list(self.field.head.parameters()), self.head_learning_rate))
        return groups
