"""How each kind of field is fitted: which rays make a batch, what is rendered, when the field's structure changes."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.base import RadianceField
from neural_sim.field.pool import RayPool
from neural_sim.field.scores import score_views
from neural_sim.types import PosedViews

Rendering = tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]


def expected_error(rendering: Rendering, pixels: Float[Tensor, "rays 4"]) -> Float[Tensor, ""]:
    """Mean square colour error over a background drawn uniformly in [0, 1], in closed form.

    With d the error of premultiplied colour, a that of opacity and b the background, the pixel's error is d - a b;
    E b = 1/2 and E b^2 = 1/3. ``pixels`` are premultiplied RGBA.
    """
    return expected_errors(rendering, pixels).mean()


def expected_errors(rendering: Rendering, pixels: Float[Tensor, "rays 4"]) -> Float[Tensor, "rays 3"]:
    """The square error of each ray and channel, of which ``expected_error`` is the mean."""
    colour = rendering[0] - pixels[:, :3]
    opacity = (rendering[1] - pixels[:, 3])[:, None]
    return colour.square() - colour * opacity + opacity.square() / 3.0


class Fitting(ABC):
    """One field with its training rays. Calls: ``start`` once, then ``loss`` and ``advance`` in each step."""

    def __init__(self, field: RadianceField, batch_rays: int) -> None:
        if batch_rays < 1:
            raise ValueError(f"fitting: batch_rays must be at least 1, got {batch_rays}")
        self.field = field
        self.batch_rays = batch_rays

    @abstractmethod
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        """Prepare field and rays for these views."""

    @abstractmethod
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        """All renderings of the next batch that the loss compares with its pixels, and these (premultiplied RGBA)."""

    def loss(self) -> Float[Tensor, ""]:
        """What the next step descends: the expected error of every rendering of the next batch."""
        renderings, pixels = self.render()
        return torch.stack([expected_error(rendering, pixels) for rendering in renderings]).sum()

    def score(self, views: PosedViews, termination: float, rays_per_chunk: int) -> dict[str, float]:
        """How well the field shows views that it is not fitted to, see ``score_views``."""
        return score_views(self.field, views, termination, rays_per_chunk)

    @abstractmethod
    def advance(self, step: int) -> bool:
        """Called after ``step`` steps; says whether the field's parameters were replaced."""

    @abstractmethod
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameter groups with their initial learning rates."""


class RayBlocks:
    """Consecutive blocks of a shuffled pool of rays, again from its beginning when fewer than a block are left."""

    def __init__(self, pool: RayPool) -> None:
        self._pool, self._next = pool, 0

    def draw(self, count: int) -> RayPool:
        """The next ``count`` rays, or the whole pool if it has fewer."""
        if self._next + count > len(self._pool):
            self._next = 0
        first, self._next = self._next, self._next + count
        return self._pool.select(slice(first, self._next))
