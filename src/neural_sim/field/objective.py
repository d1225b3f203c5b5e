"""How each kind of field is fitted: which rays make a batch, what is rendered, when the field's structure changes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.checkpoint import Checkpoint
from neural_sim.field.base import RadianceField
from neural_sim.field.pool import RayPool
from neural_sim.field.scores import Rendering, expected_error, score_views
from neural_sim.types import PosedViews


class Fitting(ABC):
    """One field with its training rays. Calls: ``start`` once, then ``loss`` and ``advance`` in each step."""

    checkpoint: Checkpoint | None = None
    """The checkpoint that the fit is taken up from and writes to; None: neither."""

    def __init__(self, field: RadianceField, batch_rays: int) -> None:
        self.field = field
        self.batch_rays = batch_rays

    @abstractmethod
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        """Prepare field and rays for these views."""

    @abstractmethod
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        """All renderings of the next batch that the loss compares with its pixels, and these (premultiplied RGBA)."""

    def loss(self) -> Float[Tensor, ""]:
        """Return what the next step descends: the expected error of every rendering of the next batch."""
        renderings, pixels = self.render()
        return torch.stack([expected_error(rendering, pixels) for rendering in renderings]).sum()

    def score(self, views: PosedViews, termination: float, rays_per_chunk: int) -> dict[str, float]:
        """How well the field shows views that it is not fitted to, see ``score_views``."""
        return score_views(self.field, views, termination, rays_per_chunk)

    @abstractmethod
    def advance(self, step: int) -> bool:
        """Act after ``step`` steps; return whether the field's parameters were replaced."""

    def state(self) -> dict[str, Any] | None:
        """Return all but the optimiser's state that a step leaves to the next; None where a step cannot be the first.

        A fitting that never returns any is not taken up where a killed run left it.
        """
        return None

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state``, just after ``start`` on the same views."""
        raise NotImplementedError(f"{type(self).__name__} returns a state, and wants restore to take it up")

    @abstractmethod
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Parameter groups with their initial learning rates."""


class RayBlocks:
    """Consecutive blocks of a shuffled pool of rays, again from its beginning when fewer than a block are left.

    ``next`` is the place of the next one.
    """

    def __init__(self, pool: RayPool) -> None:
        self._pool, self.next = pool, 0

    def draw(self, count: int) -> RayPool:
        """Return the next ``count`` rays, or the whole pool if it has fewer."""
        if self.next + count > len(self._pool):
            self.next = 0
        first, self.next = self.next, self.next + count
        return self._pool.select(slice(first, self.next))
