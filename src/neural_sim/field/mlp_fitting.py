"""Fitting the paper's network: random rays of all pixels, a loss on the coarse and on the fine rendering."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.mlp import MLPField
from neural_sim.field.objective import Fitting, RayBlocks, Rendering
from neural_sim.field.pool import build_pool
from neural_sim.field.quadrature import composite
from neural_sim.field.rendering import render_samples
from neural_sim.field.samples import sample_points
from neural_sim.types import PosedViews


class MLPFitting(Fitting):
    """Both networks at once (NeRF, Eq. 6), stratified noise in the sample distances.

    Rays of all pixels take part: empty space far from the object is learned only from rays that miss it.
    """

    field: MLPField

    def __init__(self, field: MLPField, batch_rays: int = 1024, learning_rate: float = 5e-4) -> None:
        super().__init__(field, batch_rays)
        self.learning_rate = learning_rate

    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        self._blocks = RayBlocks(build_pool(views, None, generator))
        self._generator = generator

    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        batch = self._blocks.draw(self.batch_rays)
        coarse = self.field.sample_coarse(batch.rays, self._generator)
        fine = self.field.sample_fine(batch.rays, coarse, self._generator)
        sigma, rgb = self.field.query_coarse(*sample_points(batch.rays, coarse))
        return [composite(sigma, rgb, coarse), render_samples(self.field, batch.rays, fine)], batch.pixels

    def advance(self, step: int) -> bool:
        return False

    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        return [(list(self.field.parameters()), self.learning_rate)]
