"""Uniform ranges of the coordinates that no parameter draws."""

from __future__ import annotations

import math
from dataclasses import dataclass

from neural_sim.parameter.distances import Unit, check_unit


@dataclass(frozen=True)
class Unlearned:
    """Uniform ranges of coordinates that no parameter draws: angles in degrees, the distance in ``distance_unit``.

    Raises:
        ValueError: a range that is not ordered, a distance within the object, an unknown unit.
    """

    phi_deg: tuple[float, float] = (0.0, 360.0)
    rho_deg: tuple[float, float] = (-45.0, 45.0)
    distance: tuple[float, float] = (2.4, 4.0)
    distance_unit: Unit = "radii"

    def __post_init__(self) -> None:
        for name in ("phi_deg", "rho_deg", "distance"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"unlearned.{name} must be ordered, got {[low, high]}")
        check_unit(self.distance_unit, "unlearned.distance_unit")
        smallest = 1.0 if self.distance_unit == "radii" else 0.0
        if not self.distance[0] > smallest:
            raise ValueError(
                f"unlearned.distance must be above {smallest:g} {self.distance_unit}, got {list(self.distance)}"
            )

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """By coordinate, in radians and the unit of distances."""
        phi, rho = ((math.radians(r[0]), math.radians(r[1])) for r in (self.phi_deg, self.rho_deg))
        return {"phi": phi, "rho": rho, "distance": self.distance, "magnification": (1.0, 1.0)}
