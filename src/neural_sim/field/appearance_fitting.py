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
    expected_error,
    fit_codes,
    render_lit,
    right_half,
    where_known,
)
from neural_sim.field.transient import TransientHead, composite_both, uncertain_error
from neural_sim.ranges import NonNegative, Positive, PositiveInt, validated
from neural_sim.types import PosedViews


@validated
class AppearanceFitting(Fitting):
    """``GridFitting`` for density and features; the head and codes are learned too, at rates of their own.

    Args:
        grid: makes the fitting of the field's grid.
        shared_lights: if light weights are known, a view's code combines the anchors' codes by its weights, so that the
            look of a side under one light is learned from all views of that side. Otherwise, and for photographs, each
            view learns its own code (NeRF in the Wild).
        anchors: number of views, evenly spread, whose codes become the anchors if no light weights are known.
        transients: learn what single views show in front of the object, and how uncertain each pixel is. This is for
            photographs, in which somebody may walk through the picture; rendered views have no transients. They are
            used only after the first refinement or pruning of the grid, because until then they would explain the
            object itself.
        transient_penalty: lambda_u of NeRF in the Wild, on the transients' optical depth.
    """

    field: AppearanceField

    def __init__(
        self,
        field: AppearanceField,
        grid: Callable[[GridField], GridFitting],
        code_learning_rate: Positive = 0.02,
        head_learning_rate: Positive = 0.03,
        shared_lights: bool = True,
        anchors: PositiveInt = 6,
        transients: bool = False,
        transient_penalty: NonNegative = 0.01,
    ) -> None:
        self.grid = grid(field.grid)
        super().__init__(field, self.grid.batch_rays)
        self.code_learning_rate, self.head_learning_rate = code_learning_rate, head_learning_rate
        self.shared_lights, self.anchors = shared_lights, anchors
        self.transients, self.transient_penalty = transients, transient_penalty
        self._transient: TransientHead | None = None
        self._settled = not (self.grid.refine_steps or self.grid.prune_steps)

    @override
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        self._view_weights, mixing = self._codes_of(views)
        self.field.reset_codes(mixing, generator)
        if self.transients:
            with torch.random.fork_rng(devices=[]):  # independent of what else the process has drawn
                torch.manual_seed(generator.initial_seed())
                self._transient = TransientHead(len(views)).to(self.field.codes)
            self._transient.reset(generator)
        self.grid.start(views, generator)

    def _codes_of(
        self, views: PosedViews
    ) -> tuple[Float[Tensor, "views learned"], Float[Tensor, "k learned"]]:
        """Return how each view's code, and each anchor, combines the learned codes."""
        weights = views.light_weights
        if weights is not None and self.shared_lights:
            return weights, torch.eye(weights.shape[1]).to(weights)
        own = torch.eye(len(views)).to(views.images)
        if weights is not None:
            # Least squares: the anchors whose mixtures come closest to the views' own codes.
            return own, torch.linalg.pinv(weights.double()).to(weights)
        if self.anchors > len(views):
            raise ValueError(
                f"AppearanceFitting.anchors: want at most {len(views)}, the number of views, got {self.anchors}"
            )
        return own, own[torch.linspace(0, len(views) - 1, self.anchors).long()]

    @override
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        (sigma, rgb), samples, _, _, pixels = self._decode_batch()
        return [composite(sigma, rgb, samples)], pixels

    @override
    def loss(self) -> Float[Tensor, ""]:
        static, samples, positions, seen_by, pixels = self._decode_batch()
        if self._transient is None or not self._settled:
            return expected_error(composite(*static, samples), pixels)
        transient = self._transient(positions, seen_by, self.field.grid.step)
        rendering, beta = composite_both(static, transient, samples)
        return uncertain_error(rendering, pixels, beta, transient[0] * samples.width, self.transient_penalty)

    def _decode_batch(self):
        rays, samples, cells = self.grid.next_batch()
        positions, directions = sample_points(rays.rays, samples)
        seen_by = rays.view.index_select(0, samples.ray)
        gain = self.field.gain(self._view_weights @ self.field.codes).index_select(0, seen_by)
        static = self.field.decode(self.field.grid.raw(positions, cells), directions, gain)
        return static, samples, positions, seen_by, rays.pixels

    @override
    def advance(self, step: int) -> bool:
        changed = self.grid.advance(step)
        self._settled = self._settled or changed
        return changed

    @override
    def state(self) -> dict[str, Any] | None:
        grid, transient = self.grid.state(), self._transient
        if grid is None:
            return None
        return {
            "field": self.field.state_dict(),
            "next": grid["next"],
            "transient": None if transient is None else transient.state_dict(),
            "settled": self._settled,
        }

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        self.field.load_state_dict(state["field"])
        self.grid.restore({"field": self.field.grid.state_dict(), "next": state["next"]})
        if self._transient is not None:
            self._transient.load_state_dict(state["transient"])
        self._settled = state["settled"]

    @override
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        field = self.field
        head = [p for part in (field.into, field.code, field.out) for p in part.parameters()]
        groups = [
            *self.grid.learning_rates(),
            (head, self.head_learning_rate),
            ([field.codes], self.code_learning_rate),
        ]
        if self._transient is not None:
            groups.append((list(self._transient.parameters()), self.head_learning_rate / 3.0))
        return groups

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
