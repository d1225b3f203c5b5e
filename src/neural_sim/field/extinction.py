"""Optical depth along rays that are marched wave by wave: where rays end, and where half of their light is lost."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from neural_sim.field.marching import Wave
from neural_sim.field.quadrature import OPAQUE_DEPTH

HALF = math.log(2.0)
"""Optical depth at which half of the light is left."""


class Extinction:
    """Optical depth that each of ``rays`` rays has gathered so far.

    Samples whose transmittance is below ``termination`` do not count. Each sum runs along one ray only, so that the
    rays' own dtype keeps enough digits.
    """

    def __init__(self, rays: int, termination: float, like: Float[Tensor, "*any"]) -> None:
        self._depth = like.new_zeros(rays)
        self._deepest = -math.log(termination) if termination > 0.0 else math.inf

    def enter(
        self, wave: Wave, optical: Float[Tensor, "k"]
    ) -> tuple[Float[Tensor, "k"], Bool[Tensor, "k"], Bool[Tensor, "n"]]:
        """Return the depth before each sample of depth ``optical``, which samples count, and which rays continue."""
        # One more column than steps, so that the sum before each sample is read directly, not by subtraction.
        thickness = optical.new_zeros(len(wave.ray), wave.length + 1)
        thickness[:, 0] = self._depth.index_select(0, wave.ray)
        slot = wave.place + wave.row
        thickness.view(-1).index_copy_(0, slot + 1, optical.clamp_max(OPAQUE_DEPTH))
        depth = thickness.cumsum(1)
        before = depth.view(-1).index_select(0, slot)
        after = depth[:, -1]
        alive = after < self._deepest
        # The sample that crosses the limit is the last to count. Depth rises along a row, so a search finds it.
        limit = torch.full_like(after, self._deepest)[:, None]
        crossing = torch.searchsorted(depth, limit).clamp_max(wave.length)
        self._depth.index_copy_(0, wave.ray, depth.gather(1, crossing)[:, 0])
        return before, before < self._deepest, alive

    def opacity(self) -> Float[Tensor, "rays"]:
        """Return the fraction of light that all counted samples absorb: the sum of their weights."""
        return -torch.expm1(-self._depth)


class Surface:
    """The distance, in object radii, at which each of ``rays`` rays has lost half of its light.

    It is 0 for rays that lose less than half (opacity below 1/2). As in the quadrature, density is constant
    over the length of ray that a sample represents.
    """

    def __init__(self, rays: int, like: Float[Tensor, "*any"]) -> None:
        self.distance = like.new_zeros(rays)

    def enter(
        self,
        ray: Int[Tensor, "k"],
        middle: Float[Tensor, "k"],
        width: Float[Tensor, "k"] | float,
        before: Float[Tensor, "k"],
        optical: Float[Tensor, "k"],
    ) -> None:
        """Add samples.

        Args:
            ray: the ray of each sample.
            middle: the distance of its middle.
            width: the length of ray that it represents.
            before: the optical depth before it.
            optical: its own optical depth.
        """
        here = ((before < HALF) & (before + optical >= HALF)).nonzero()[:, 0]
        fraction = (HALF - before.index_select(0, here)) / optical.index_select(0, here)
        length = width.index_select(0, here) if isinstance(width, Tensor) else width
        crossing = middle.index_select(0, here) + (fraction - 0.5) * length
        self.distance.index_copy_(0, ray.index_select(0, here), crossing)


def sum_rows(values: Float[Tensor, "k c"], weights: Float[Tensor, "k"], wave: Wave) -> Float[Tensor, "n c"]:
    """Sum the weighted samples of each ray in a wave."""
    every = torch.arange(len(values), device=values.device)
    first = wave.count.cumsum(0) - wave.count
    return functional.embedding_bag(every, values, first, per_sample_weights=weights, mode="sum")
