"""The anchor lights that an illumination mixes, and the lights of training views."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor

from neural_sim.ranges import (
    Ascending,
    Fraction,
    NonNegative,
    Positive,
    PositiveFraction,
    PositiveInt,
    validated,
)
from neural_sim.renderer.lighting import Kelvin, Light, Lighting, temperature_colour

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@validated
@dataclass(frozen=True)
class LightRig:
    """k anchor lights around an object, and mixtures of them: shade = ambient + sum_i w_i light_i.

    Directions lie on a spherical Fibonacci lattice. Temperatures are evenly spaced in mired over ``temperature_range``
    (kelvin), intensities over ``intensity_range``, both in shuffled orders, so that neither correlates with direction.
    ``fill`` is the fraction of each light that comes from all sides.

    Raises:
        ValueError: ``ambient`` and the largest intensity add up to more than 1. Up to 1, white surfaces stay within
            [0, 1] under all weights on the simplex.
    """

    anchors: Annotated[int, Ge(2)] = 6
    temperature_range: Annotated[tuple[Kelvin, Kelvin], Ascending()] = (2700.0, 9000.0)
    intensity_range: Annotated[tuple[Positive, Positive], Ascending()] = (0.5, 0.9)
    fill: Fraction = 0.35
    ambient: NonNegative = 0.1

    def __post_init__(self) -> None:
        if self.ambient + self.intensity_range[1] > 1.0 + 1e-9:
            raise ValueError(
                f"LightRig.ambient: want at most 1 together with the largest intensity, {self.intensity_range[1]}, so "
                f"that white surfaces do not saturate; got {self.ambient}"
            )

    def lights(self) -> tuple[Light, ...]:
        """Return the k anchors."""
        k = self.anchors
        height = [1.0 - (2.0 * i + 1.0) / k for i in range(k)]
        spread = zip(height, _spread(k, math.sqrt(5.0)), _spread(k, math.sqrt(2.0)), strict=True)
        return tuple(
            self._light(z, GOLDEN_ANGLE * i, warm, bright) for i, (z, warm, bright) in enumerate(spread)
        )

    def _light(self, height: float, turn: float, warm: float, bright: float) -> Light:
        """Make a light from its height in [-1, 1], its turn about +z, and places in [0, 1] within both ranges."""
        radius = math.sqrt(1.0 - height * height)
        direction = (radius * math.cos(turn), radius * math.sin(turn), height)
        (low, high), (dim, full) = self.temperature_range, self.intensity_range
        kelvin = 1.0 / (1.0 / low + warm * (1.0 / high - 1.0 / low))
        return Light(direction, dim + bright * (full - dim), temperature_colour(kelvin), self.fill)

    def lighting(self, weights: Sequence[float] | Float[Tensor, "k"]) -> Lighting:
        """Return the mixture of the anchors with these weights, which may have either sign.

        Raises:
            ValueError: the number of weights is not that of the anchors.
        """
        values = [float(weight) for weight in weights]
        if len(values) != self.anchors:
            raise ValueError(f"lights: want {self.anchors} weights, got {len(values)}")
        lights = (
            replace(light, intensity=light.intensity * weight)
            for light, weight in zip(self.lights(), values, strict=True)
            if weight != 0.0
        )
        return Lighting(tuple(lights), self.ambient)


@validated
@dataclass(frozen=True)
class VariedLight:
    """The lights under which a field's training views are rendered.

    A fraction ``anchored`` of the views, evenly spread, are lit by one anchor each, in turn. The others are lit by
    mixtures, also in turn; there are ``mixtures`` of these, drawn uniformly from the simplex.
    """

    rig: LightRig = field(default_factory=LightRig)
    anchored: PositiveFraction = 0.5
    mixtures: PositiveInt = 12

    def weights(self, count: int, generator: torch.Generator) -> Float[Tensor, "count k"]:
        """Return each view's weights over the anchors, float32.

        Raises:
            ValueError: there are too few views to show every anchor.
        """
        k = self.rig.anchors
        if math.floor(count * self.anchored) < k:
            raise ValueError(
                f"views.lights.anchored: {self.anchored} of {count} views cannot show all {k} anchors"
            )
        uniform = torch.rand((self.mixtures, k), generator=generator, dtype=torch.float64)
        exponential = -uniform.clamp_min(1e-12).log()
        mixed = itertools.cycle(exponential / exponential.sum(-1, keepdim=True))
        pure = itertools.cycle(torch.eye(k, dtype=torch.float64))
        steps = [
            math.floor((view + 1) * self.anchored) > math.floor(view * self.anchored) for view in range(count)
        ]
        return torch.stack([next(pure if anchored else mixed) for anchored in steps]).float()


def _spread(count: int, ratio: float) -> list[float]:
    """Return ``count`` evenly spaced numbers in [0, 1], ordered as the fractional parts of multiples of ``ratio``."""
    order = sorted(range(count), key=lambda i: (i * ratio) % 1.0)
    rank = {i: place for place, i in enumerate(order)}
    return [rank[i] / (count - 1) for i in range(count)]
