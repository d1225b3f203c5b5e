"""Directional lights fixed in the object's frame, shading by Lambert's law, and the colours of black bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le
from jaxtyping import Float

from neural_sim.ranges import Fraction, Matching, NonNegative, check, validated

Vector = tuple[float, float, float]
Kelvin = Annotated[float, Ge(1500.0), Le(40000.0)]
"""Temperatures of black bodies. Colours below about 1900 K lie outside sRGB's gamut: negative blue becomes 0."""

SECOND_RADIATION_CONSTANT = 1.438777e7  # h c / k in nm K
SRGB_FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)  # IEC 61966-2-1
LOBES = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
"""The CIE 1931 observer's x, y and z, each a sum of lobes: height, then centre, width below and width above the centre
in nm (Wyman et al. 2013)."""


@validated
@dataclass(frozen=True)
class Light:
    """A directional light. ``direction`` points towards it, in the object's frame; its length must not be zero.

    ``colour`` is sRGB and multiplies ``intensity``; a negative intensity removes light (as in affine mixtures).
    ``fill`` is the fraction that arrives from all sides, as if scattered by the walls of a room.
    """

    direction: Annotated[Vector, Matching(any, "three numbers, not all of them zero")]
    intensity: float
    colour: tuple[Fraction, Fraction, Fraction] = (1.0, 1.0, 1.0)
    fill: Fraction = 0.0


@validated
@dataclass(frozen=True)
class Lighting:
    """Ambient and directional light: a white surface has the colour ``ambient`` plus the contributions of ``lights``.

    The colour is linear in the lights' intensities as long as nothing leaves [0, 1]. Colours are sRGB values; gamma is
    ignored.
    """

    lights: tuple[Light, ...] = (Light((0.3, 0.4, 1.0), 0.3),)
    ambient: NonNegative = 0.7


def lambert(normals: Float[np.ndarray, "n 3"], lighting: Lighting) -> Float[np.ndarray, "n 3"]:
    """Return the factor on the albedo at unit normals: ambient + sum_i I_i c_i (f_i + (1 - f_i) max(n . l_i, 0)).

    Where negative intensities make it negative, it is 0.
    """
    shade = np.full((len(normals), 3), lighting.ambient)
    for light in lighting.lights:
        towards = np.asarray(light.direction, dtype=np.float64)
        towards = towards / np.linalg.norm(towards)
        facing = light.fill + (1.0 - light.fill) * np.maximum(normals @ towards, 0.0)
        shade = shade + light.intensity * np.asarray(light.colour) * facing[:, None]
    return np.maximum(shade, 0.0)


def temperature_colour(kelvin: float) -> Vector:
    """Return the sRGB colour (gamma encoded, largest channel 1) of a black body, by Planck's law and CIE 1931.

    Raises:
        ValueError: ``kelvin`` is outside the range of ``Kelvin``.
    """
    check(kelvin, Kelvin, "temperature_colour.kelvin")
    wavelength = np.arange(360.0, 831.0, 5.0)
    radiance = wavelength**-5 / np.expm1(SECOND_RADIATION_CONSTANT / (wavelength * kelvin))
    observer = np.stack([sum(_lobe(wavelength, *lobe) for lobe in lobes) for lobes in LOBES])
    linear = np.maximum(SRGB_FROM_XYZ @ (observer @ radiance), 0.0)
    linear = linear / linear.max()
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    red, green, blue = np.clip(encoded, 0.0, 1.0).tolist()
    return red, green, blue


def _lobe(at: np.ndarray, height: float, centre: float, below: float, above: float) -> np.ndarray:
    return height * np.exp(-0.5 * ((at - centre) / np.where(at < centre, below, above)) ** 2)
