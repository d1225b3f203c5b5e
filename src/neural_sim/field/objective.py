"""How each kind of field is fitted: which rays form a batch, what is rendered, when the field's structure changes."""

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
    """One field with its training rays. ``start`` is called once, then ``loss`` and ``advance`` in each step."""

    checkpoint: Checkpoint | None = None
    """The checkpoint from which the fit resumes and to which it writes; None: neither."""

    def __init__(self, field: RadianceField, batch_rays: int) -> None:
        self.field = field
        self.batch_rays = batch_rays

    @abstractmethod
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        """Prepare field and rays for these views."""

    @abstractmethod
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        """Render the next batch, in every way that the loss needs; also return its pixels (premultiplied RGBA)."""

    def loss(self) -> Float[Tensor, ""]:
        """Return what the next step minimises: the expected errors of all renderings of the next batch, summed."""
        renderings, pixels = self.render()
        return torch.stack([expected_error(rendering, pixels) for rendering in renderings]).sum()

    def score(self, views: PosedViews, termination: float, rays_per_chunk: int) -> dict[str, float]:
        """Score the field on views to which it is not fitted, see ``score_views``."""
        return score_views(self.field, views, termination, rays_per_chunk)

    @abstractmethod
    def advance(self, step: int) -> bool:
        """Change the field's structure if due after ``step`` steps; return whether its parameters were replaced."""

    def state(self) -> dict[str, Any] | None:
        """Return what the next step needs, except the optimiser's state; None if a fit cannot resume at this step.

        A fitting that never returns a state does not resume interrupted runs.
        """
        return None

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a ``state``, directly after ``start`` on the same views."""
        raise NotImplementedError(f"{type(self).__name__} returns a state but does not implement restore")

    @abstractmethod
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        """Return parameter groups with their initial learning rates."""


class RayBlocks:
    """Hands out consecutive blocks of a shuffled pool of rays, and starts over if less than a block is left.

    ``next`` is the start of the next block.
    """

    def __init__(self, pool: RayPool) -> None:
        self._pool, self.next = pool, 0

    def draw(self, count: int) -> RayPool:
        """Return the next ``count`` rays, or the whole pool if it has fewer."""
        if self.next + count > len(self._pool):
            self.next = 0
        first, self.next = self.next, self.next + count
        return self._pool.select(slice(first, self.next))
