"""One directional and one ambient light, fixed in the object's frame, and Lambert's law under them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Lighting:
    """``direction`` points towards the light, in the world frame; it need not be of unit length.

    A white surface that faces the light has the colour ``ambient + directional``; one that faces away has
    ``ambient``. Colours are sRGB values without gamma handling.
    """

    direction: tuple[float, float, float] = (0.3, 0.4, 1.0)
    ambient: float = 0.7
    directional: float = 0.3

    def __post_init__(self) -> None:
        if len(self.direction) != 3 or not all(map(math.isfinite, self.direction)) or not any(self.direction):
            raise ValueError(
                f"lighting.direction: want three finite numbers, not all zero, got {self.direction}"
            )
        for name in ("ambient", "directional"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"lighting.{name}: want a finite number of at least 0, got {value}")


def lambert(normals: Float[np.ndarray, "n 3"], lighting: Lighting) -> Float[np.ndarray, "n"]:
    """What albedo is multiplied by: ``ambient + directional * max(n . l, 0)``, for unit normals."""
    towards = np.asarray(lighting.direction, dtype=np.float64)
    towards = towards / np.linalg.norm(towards)
    return lighting.ambient + lighting.directional * np.maximum(normals @ towards, 0.0)
