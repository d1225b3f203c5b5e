"""A grid field whose colour, and nothing else, depends on an appearance code (NeRF in the Wild, Martin-Brualla 2021).

The code scales the hidden units of the colour head: the gains 1 + W c are the same at every sample, so that a field
under one code is as fast as one without, and the colour's logits are affine in the code, as shading is linear in light.
(A shift of the hidden layer's bias, which is what appending the code to its input amounts to, renders a side under a
light that no view showed it in about 2 dB worse.)
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neural_sim.field.base import PackedSamples, RadianceField
from neural_sim.field.grid import GridField
from neural_sim.field.interpolation import gather_weighted, trilinear_tangents
from neural_sim.field.marching import lookup
from neural_sim.types import Rays

INITIAL_CODE = 0.3
"""Standard deviation of new codes."""


class AppearanceField(RadianceField):
    """``GridField`` for density and features, and a colour head of one hidden layer that sees features and a code.

    The first three features also pass straight to the colour's logits, so that the head has only the light to learn.
    ``learned`` codes of ``code_size`` numbers are fitted, one for each light of the training views or one for each
    view; the ``anchors`` are those k affine combinations of them that an illumination weighs: rows of ``mixing``
    (k, learned) add up to 1. ``view_dependent`` shows the head the viewing direction; Lambertian objects need none.
    Queried without a code, the field is under its anchors' mean.
    """

    def __init__(
        self,
        features: int = 6,
        head_width: int = 32,
        code_size: int = 48,
        view_dependent: bool = False,
        step_cells: float = 1.0,
        initial_density: float = -3.0,
        density_gain: float = 2.0,
        learned: int = 1,
        anchors: int = 1,
    ) -> None:
        super().__init__()
        if min(head_width, code_size, learned, anchors) < 1:
            raise ValueError(
                "AppearanceField: head_width, code_size, learned and anchors must be at least 1, got "
                f"{head_width}, {code_size}, {learned}, {anchors}"
            )
        self.grid = GridField(features, 0, step_cells, initial_density, density_gain)
        self.view_dependent = view_dependent
        self.into = nn.Linear(features + 3 * view_dependent, head_width)
        self.code = nn.Linear(code_size, head_width, bias=False)
        self.out = nn.Linear(head_width, 3)
        self.codes = nn.Parameter(torch.zeros(learned, code_size))
        self.register_buffer("mixing", torch.full((anchors, learned), 1.0 / learned))
        self.mixing: Tensor

    def settings(self) -> dict[str, object]:
        return {
            "features": self.grid.features,
            "head_width": self.out.in_features,
            "code_size": self.code.in_features,
            "view_dependent": self.view_dependent,
            "step_cells": self.grid.step_cells,
            "initial_density": self.grid.initial_density,
            "density_gain": self.grid.density_gain,
            "learned": len(self.codes),
            "anchors": len(self.mixing),
        }

    def reset_codes(self, mixing: Float[Tensor, "k learned"], generator: torch.Generator) -> None:
        """Random codes, and how the anchors combine them."""
        shape = (mixing.shape[1], self.code.in_features)
        drawn = INITIAL_CODE * torch.randn(shape, generator=generator, device=generator.device)
        self.codes = nn.Parameter(drawn.to(self.codes))
        self.mixing = mixing.to(self.codes)

    @property
    def anchors(self) -> Float[Tensor, "k code"]:
        """The codes that an illumination weighs."""
        return self.mixing @ self.codes

    def lit(self, code: Float[Tensor, "code"]) -> LitField:
        """This field under one code."""
        return LitField(self, self.gain(code))

    def gain(self, code: Float[Tensor, "*n code"]) -> Float[Tensor, "*n width"]:
        """What a code multiplies the head's hidden units by."""
        return 1.0 + self.code(code)

    def decode(
        self,
        raw: Float[Tensor, "samples channels"],
        directions: Float[Tensor, "samples 3"],
        gain: Float[Tensor, "*samples width"],
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Density and colour of table rows under one gain, or one for each sample."""
        hidden = functional.silu(self.into(self._seen(raw, directions)))
        if gain.ndim == 1:
            logits = functional.linear(hidden, self.out.weight * gain, self.out.bias)
        else:
            logits = self.out(hidden * gain)
        return self.grid.density(raw), torch.sigmoid(raw[:, 1:4] + logits)

    def _seen(self, raw: Tensor, directions: Tensor) -> Float[Tensor, "*samples inputs"]:
        return torch.cat([raw[..., 1:], directions], -1) if self.view_dependent else raw[..., 1:]

    @torch.no_grad()
    def query_with_tangents_of_code(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
        gain: Float[Tensor, "width"],
        gain_rates: Float[Tensor, "q width"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Float[Tensor, "samples q 3"]]:
        """``query_with_tangents`` under a gain, and the colour's q derivatives where the gain moves at its rates.

        Both m and q may be 0. All in closed form; a moving gain costs one small product a sample.
        """
        raw, raw_rates = _raw_with_tangents(self.grid, positions, velocities)
        before = self.into(self._seen(raw, directions))
        gate = torch.sigmoid(before)
        hidden, weight = before * gate, self.out.weight * gain
        rgb = torch.sigmoid(raw[:, 1:4] + functional.linear(hidden, weight, self.out.bias))
        rgb_slope = rgb * (1.0 - rgb)
        moved = functional.linear(self._seen(raw_rates, turns), self.into.weight)
        moved = moved * (gate * (1.0 + before * (1.0 - gate)))  # the slope of SiLU
        rgb_rates = rgb_slope * (raw_rates[..., 1:4] + functional.linear(moved, weight))
        towards = (self.out.weight * gain_rates[:, None]).flatten(0, 1)
        code_rates = rgb_slope[:, None] * (hidden @ towards.t()).unflatten(1, (-1, 3))
        slope = self.grid.density_gain / float(self.grid.cell)
        sigma_rates = slope * torch.sigmoid(self.grid.density_gain * raw[:, 0]) * raw_rates[..., 0]
        return self.grid.density(raw), rgb, sigma_rates, rgb_rates, code_rates

    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self.decode(self.grid.raw(positions), directions, self.gain(self.anchors.mean(0)))

    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        return self.grid.sample(rays, termination)


class LitField(RadianceField):
    """An appearance field under one code; shares its tensors."""

    def __init__(self, field: AppearanceField, gain: Float[Tensor, "width"]) -> None:
        super().__init__()
        self.field, self.gain = field, gain

    def settings(self) -> dict[str, object]:
        raise TypeError("LitField: save the appearance field itself")

    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self.field.decode(self.field.grid.raw(positions), directions, self.gain)

    def query_with_tangents(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See the base class; in closed form."""
        still = self.gain.new_zeros(0, len(self.gain))
        return self.field.query_with_tangents_of_code(
            positions, directions, velocities, turns, self.gain, still
        )[:4]

    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        return self.field.sample(rays, termination)


def _raw_with_tangents(
    grid: GridField, positions: Float[Tensor, "samples 3"], velocities: Float[Tensor, "m samples 3"]
) -> tuple[Float[Tensor, "samples channels"], Float[Tensor, "m samples channels"]]:
    """Table rows, and their derivatives where positions move at ``velocities``."""
    if not len(velocities):
        raw = grid.raw(positions)
        return raw, raw.new_zeros(0, *raw.shape)
    local = (positions - grid.origin) / float(grid.cell)
    base = local.floor()
    cells = lookup(base, grid.occupancy)
    corners = grid.corners.index_select(0, torch.where(cells < 0, len(grid.corners) - 1, cells))
    weights, rates = trilinear_tangents(local - base, velocities / float(grid.cell))
    raw = gather_weighted(grid.table, corners, weights)
    return raw, torch.stack([gather_weighted(grid.table, corners, rate) for rate in rates])
