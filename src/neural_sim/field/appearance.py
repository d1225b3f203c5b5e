"""A grid field in which only colour depends on an appearance code (NeRF in the Wild, Martin-Brualla et al. 2021).

The code scales the hidden units of the colour head. The gains 1 + W c are the same at every sample, so that a field
under one code is as fast as one without; and the colour's logits are affine in the code, as shading is linear in light.
(The alternative, appending the code to the hidden layer's input, only shifts the layer's bias. It is about 2 dB worse
on sides rendered under a light in which no training view shows them.)
"""

from __future__ import annotations

import copy
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from neural_sim.field.base import RadianceField
from neural_sim.field.extinction import Surface
from neural_sim.field.grid import GridField
from neural_sim.field.quadrature import PackedSamples, Span
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import PinholeCamera, Rays

INITIAL_CODE = 0.3
"""Standard deviation of new codes."""


@validated
class AppearanceField(RadianceField):
    """``GridField`` for density and features, and a colour head with one hidden layer over features and a code.

    The first three features are also added to the colour's logits, so that the head only has to learn the light.
    ``learned`` codes of ``code_size`` numbers are fitted, one for each light of the training views or one for each
    view. The ``anchors``, which an illumination mixes, are k affine combinations of them: rows of ``mixing`` (k,
    learned) add up to 1. With ``view_dependent`` the head also sees the viewing direction, which Lambertian objects do
    not need. A query without a code uses the mean of the anchors.
    """

    def __init__(
        self,
        features: Annotated[int, Ge(3)] = 6,
        head_width: PositiveInt = 32,
        code_size: PositiveInt = 48,
        view_dependent: bool = False,
        step_cells: Annotated[float, Gt(0), Le(2)] = 1.0,
        initial_density: float = -3.0,
        density_gain: Positive = 2.0,
        learned: PositiveInt = 1,
        anchors: PositiveInt = 1,
    ) -> None:
        super().__init__()
        self.grid = GridField(features, 0, step_cells, initial_density, density_gain)
        self.directed = view_dependent
        self.into = nn.Linear(features + 3 * view_dependent, head_width)
        self.code = nn.Linear(code_size, head_width, bias=False)
        self.out = nn.Linear(head_width, 3)
        self.codes = nn.Parameter(torch.zeros(learned, code_size))
        self.register_buffer("mixing", torch.full((anchors, learned), 1.0 / learned))
        self.mixing: Tensor

    @override
    def settings(self) -> dict[str, object]:
        return {
            "features": self.grid.features,
            "head_width": self.out.in_features,
            "code_size": self.code.in_features,
            "view_dependent": self.directed,
            "step_cells": self.grid.step_cells,
            "initial_density": self.grid.initial_density,
            "density_gain": self.grid.density_gain,
            "learned": len(self.codes),
            "anchors": len(self.mixing),
        }

    def reset_codes(self, mixing: Float[Tensor, "k learned"], generator: torch.Generator) -> None:
        """Draw random codes, and set how the anchors combine them."""
        shape = (mixing.shape[1], self.code.in_features)
        drawn = INITIAL_CODE * torch.randn(shape, generator=generator, device=generator.device)
        self.codes = nn.Parameter(drawn.to(self.codes))
        self.mixing = mixing.to(self.codes)

    @property
    def anchors(self) -> Float[Tensor, "k code"]:
        """The codes that an illumination mixes."""
        return self.mixing @ self.codes

    def lit(self, code: Float[Tensor, "code"], rates: Float[Tensor, "q code"] | None = None) -> LitField:
        """Return this field under one code, which changes at ``rates`` (None: it is constant)."""
        gain = self.gain(code)
        gain_rates = (
            gain.new_zeros(0, len(gain)) if rates is None else functional.linear(rates, self.code.weight)
        )
        return LitField(self, gain, gain_rates)

    @override
    def with_step(self, multiple: float) -> AppearanceField:
        if multiple == 1.0:
            return self
        other = copy.copy(self)
        # A shallow copy shares the dictionary of modules, which an assignment would change in both.
        other._modules = {**self._modules, "grid": self.grid.with_step(multiple)}
        return other

    def gain(self, code: Float[Tensor, "*n code"]) -> Float[Tensor, "*n width"]:
        """Return the factors on the head's hidden units under a code."""
        return 1.0 + self.code(code)

    def decode(
        self,
        raw: Float[Tensor, "samples channels"],
        directions: Float[Tensor, "samples 3"] | None,
        gain: Float[Tensor, "*samples width"],
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Return density and colour of table rows under one gain, or one for each sample.

        A field without view dependence needs no directions.
        """
        hidden = functional.silu(self.into(self.seen(raw, directions)))
        if gain.ndim == 1:
            logits = functional.linear(hidden, self.out.weight * gain, self.out.bias)
        else:
            logits = self.out(hidden * gain)
        return self.grid.density(raw), torch.sigmoid(raw[:, 1:4] + logits)

    def seen(self, raw: Tensor, directions: Tensor | None) -> Float[Tensor, "*samples inputs"]:
        """Return the head's inputs from table rows (or their rates) and directions."""
        if not self.directed:
            return raw[..., 1:]
        assert directions is not None
        return torch.cat([raw[..., 1:], directions], -1)

    @override
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self.lit(self.anchors.mean(0)).query(positions, directions)

    @override
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        return self.grid.sample(rays, termination)

    @property
    @override
    def reach(self) -> float:
        return self.grid.reach


class LitField(RadianceField):
    """An appearance field under one code, with shared tensors; its colour also has derivatives for the code's rates."""

    def __init__(
        self, field: AppearanceField, gain: Float[Tensor, "width"], gain_rates: Float[Tensor, "q width"]
    ) -> None:
        super().__init__()
        self.field, self.gain, self.gain_rates = field, gain, gain_rates
        self.light_rates, self.directed = len(gain_rates), field.directed

    @override
    def settings(self) -> dict[str, object]:
        raise TypeError("LitField: save the appearance field itself")

    @override
    def with_step(self, multiple: float) -> LitField:
        return LitField(self.field.with_step(multiple), self.gain, self.gain_rates)

    @override
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        return self.field.sample(rays, termination)

    @override
    def span(self, camera: PinholeCamera, camera_to_world: Float[Tensor, "4 4"], rows: range) -> Span:
        return self.field.grid.span(camera, camera_to_world, rows)

    @override
    def trace(
        self,
        rays: Rays,
        termination: float,
        span: Span | None = None,
        skip_empty: bool = True,
        surface: Surface | None = None,
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        grid = self.field.grid
        return grid.trace_as(self._decode, self.directed, rays, termination, span, skip_empty, surface)

    @property
    @override
    def reach(self) -> float:
        return self.field.reach

    @override
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self._decode(self.field.grid.raw(positions), directions)

    def _decode(
        self, raw: Float[Tensor, "samples channels"], directions: Float[Tensor, "samples 3"] | None
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self.field.decode(raw, directions, self.gain)

    @torch.no_grad()
    def query_with_tangents(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See the base class; here m may be 0.

        The derivatives are in closed form, so that each rate of the code costs one small product per sample.
        """
        field, grid = self.field, self.field.grid
        raw, raw_rates = grid.raw_with_tangents(positions, velocities)
        before = field.into(field.seen(raw, directions))
        gate = torch.sigmoid(before)
        hidden, weight = before * gate, field.out.weight * self.gain
        rgb = torch.sigmoid(raw[:, 1:4] + functional.linear(hidden, weight, field.out.bias))
        moved = functional.linear(field.seen(raw_rates, turns), field.into.weight)
        moved = moved * (gate * (1.0 + before * (1.0 - gate)))  # the slope of SiLU
        by_camera = raw_rates[..., 1:4] + functional.linear(moved, weight)
        by_light = torch.einsum("sw,qcw->qsc", hidden, field.out.weight * self.gain_rates[:, None])
        rgb_rates = (rgb * (1.0 - rgb)) * torch.cat([by_camera, by_light])
        return grid.density(raw), rgb, grid.density_rates(raw, raw_rates), rgb_rates
