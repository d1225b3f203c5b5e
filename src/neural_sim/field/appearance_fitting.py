"""Fitting a field with appearance codes, and scoring it on views under other lights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.objective import Fitting, Rendering
from neural_sim.field.quadrature import composite
from neural_sim.field.rendering import render_views
from neural_sim.field.samples import sample_points
from neural_sim.field.scores import compare
from neural_sim.types import PosedViews


class AppearanceFitting(Fitting):
    """``GridFitting`` for density and features; head and codes learn beside it, at rates of their own.

    Views share the codes of the anchor lights in the proportions of their light weights: what a side looks like under
    one light is learned from all views of that side. ``grid`` makes the fitting of the field's grid. ``start`` and
    ``score`` raise ``ValueError`` for views of unknown light.
    """

    field: AppearanceField

    def __init__(
        self,
        field: AppearanceField,
        grid: Callable[[GridField], GridFitting],
        code_learning_rate: float = 0.02,
        head_learning_rate: float = 0.03,
    ) -> None:
        self.grid = grid(field.grid)
        super().__init__(field, self.grid.batch_rays)
        self.code_learning_rate, self.head_learning_rate = code_learning_rate, head_learning_rate

    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        self._view_weights = _light_of(views)
        self.field.reset_codes(self._view_weights.shape[1], generator)
        self.grid.start(views, generator)

    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        rays, samples, cells = self.grid.next_batch()
        positions, directions = sample_points(rays.rays, samples)
        seen_by = rays.view.index_select(0, samples.ray)
        gain = self.field.gain(self._view_weights @ self.field.anchors).index_select(0, seen_by)
        decoded = self.field.decode(self.field.grid.raw(positions, cells), directions, gain)
        return [composite(*decoded, samples)], rays.pixels

    def advance(self, step: int) -> bool:
        return self.grid.advance(step)

    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        field = self.field
        head = [p for part in (field.into, field.code, field.out) for p in part.parameters()]
        codes = ([field.anchors], self.code_learning_rate)
        return [*self.grid.learning_rates(), (head, self.head_learning_rate), codes]

    def score(self, views: PosedViews, termination: float, rays_per_chunk: int) -> dict[str, float]:
        """Whole views under their lights, which shows the anchors and their mixtures."""
        codes = _light_of(views) @ self.field.anchors
        return compare(render_lit(self.field, codes, views, termination, rays_per_chunk), views.images)


@torch.no_grad()
def render_lit(
    field: AppearanceField,
    codes: Float[Tensor, "views code"],
    views: PosedViews,
    termination: float,
    rays_per_chunk: int,
) -> Float[Tensor, "views height width 4"]:
    """Premultiplied RGBA from the views' cameras, each under its own code."""
    poses = views.camera_to_world
    rendered = [
        render_views(field.lit(code), views.camera, poses[i : i + 1], termination, rays_per_chunk)
        for i, code in enumerate(codes)
    ]
    return torch.cat(rendered)


def _light_of(views: PosedViews) -> Float[Tensor, "views k"]:
    if views.light_weights is None:
        raise ValueError(
            "field=grid_w: want views under varied light (renderer=nerf_w), got views of one light"
        )
    return views.light_weights
