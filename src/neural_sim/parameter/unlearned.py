"""Uniform ranges of the coordinates that no parameter draws."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Unlearned:
    """Uniform ranges of coordinates that no parameter draws: angles in degrees, the distance in object radii.

    Raises:
        ValueError: a range that is not ordered, a distance within the object.
    """

    phi_deg: tuple[float, float] = (0.0, 360.0)
    rho_deg: tuple[float, float] = (-45.0, 45.0)
    distance: tuple[float, float] = (2.4, 4.0)

    def __post_init__(self) -> None:
        for name in ("phi_deg", "rho_deg", "distance"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"unlearned.{name} must be ordered, got {[low, high]}")
        if not self.distance[0] > 1.0:
            raise ValueError(f"unlearned.distance must be above 1 radius, got {list(self.distance)}")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """By coordinate, in radians and radii."""
        phi, rho = ((math.radians(r[0]), math.radians(r[1])) for r in (self.phi_deg, self.rho_deg))
        return {"phi": phi, "rho": rho, "distance": self.distance, "magnification": (1.0, 1.0)}
