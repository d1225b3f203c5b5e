"""Fit a field with appearance codes, and score it on views under other lights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.objective import Fitting
from neural_sim.field.quadrature import composite, sample_points
from neural_sim.field.scores import (
    Rendering,
    compare,
    fit_codes,
    render_lit,
    right_half,
    where_known,
)
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import PosedViews


@validated
class AppearanceFitting(Fitting):
    """``GridFitting`` for density and features; the head and codes are learned too, at rates of their own.

    Args:
        grid: makes the fitting of the field's grid.
        anchors: number of views, evenly spread, whose codes become the anchors if no light weights are known.
    """

    field: AppearanceField

    def __init__(
        self,
        field: AppearanceField,
        grid: Callable[[GridField], GridFitting],
        code_learning_rate: Positive = 0.02,
        head_learning_rate: Positive = 0.03,
        anchors: PositiveInt = 6,
    ) -> None:
        self.grid = grid(field.grid)
        super().__init__(field, self.grid.batch_rays)
        self.code_learning_rate, self.head_learning_rate = code_learning_rate, head_learning_rate
        self.anchors = anchors

    @override
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        self._view_weights, mixing = self._codes_of(views)
        self.field.reset_codes(mixing, generator)
        self.grid.start(views, generator)

    def _codes_of(
        self, views: PosedViews
    ) -> tuple[Float[Tensor, "views learned"], Float[Tensor, "k learned"]]:
        """Return how each view's code, and each anchor, combines the learned codes.

        If light weights are known, a view's code combines the anchors' codes by its weights, so that the look of a side
        under one light is learned from all views of that side. Photographs learn a code each (NeRF in the Wild).
        """
        weights = views.light_weights
        if weights is not None:
            return weights, torch.eye(weights.shape[1]).to(weights)
        if self.anchors > len(views):
            raise ValueError(
                f"AppearanceFitting.anchors: want at most {len(views)}, the number of views, got {self.anchors}"
            )
        own = torch.eye(len(views)).to(views.images)
        return own, own[torch.linspace(0, len(views) - 1, self.anchors).long()]

    @override
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        rays, samples, cells = self.grid.next_batch()
        positions, directions = sample_points(rays.rays, samples)
        seen_by = rays.view.index_select(0, samples.ray)
        gain = self.field.gain(self._view_weights @ self.field.codes).index_select(0, seen_by)
        sigma, rgb = self.field.decode(self.field.grid.raw(positions, cells), directions, gain)
        return [composite(sigma, rgb, samples)], rays.pixels

    @override
    def advance(self, step: int) -> bool:
        return self.grid.advance(step)

    @override
    def state(self) -> dict[str, Any] | None:
        grid = self.grid.state()
        return None if grid is None else {"field": self.field.state_dict(), "next": grid["next"]}

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        self.field.load_state_dict(state["field"])
        self.grid.restore({"field": self.field.grid.state_dict(), "next": state["next"]})

    @override
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        field = self.field
        head = [p for part in (field.into, field.code, field.out) for p in part.parameters()]
        return [
            *self.grid.learning_rates(),
            (head, self.head_learning_rate),
            ([field.codes], self.code_learning_rate),
        ]

    def score(self, views: PosedViews, termination: float, rays_per_chunk: int) -> dict[str, float]:
        """Score whole views under their known lights, which tests the anchors and their mixtures.

        For views of unknown light, a code is fitted to each view's left half and the right half is scored, as in NeRF
        in the Wild.
        """
        if views.light_weights is not None:
            codes = views.light_weights @ self.field.anchors
            return compare(render_lit(self.field, codes, views, termination, rays_per_chunk), views.images)
        codes = fit_codes(self.field, views, termination)
        rendered = where_known(render_lit(self.field, codes, views, termination, rays_per_chunk), views)
        return compare(right_half(rendered), right_half(views.images))
