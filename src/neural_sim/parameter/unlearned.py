"""Coordinates that no parameter draws: their uniform ranges, and the unit of the camera's distance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from neural_sim.ranges import Ascending, Positive, validated

Unit = Literal["radii", "metres"]
"""Radii of each object, or metres, which need objects of known size."""
NEAREST = 1.05
"""Smallest distance, in object radii, at which a camera is safely outside the object."""


@validated
@dataclass(frozen=True)
class Unlearned:
    """Uniform ranges of coordinates that no parameter draws: angles in degrees, the distance in ``distance_unit``.

    Raises:
        ValueError: a range is not ordered, a distance is within the object, or the unit is unknown.
    """

    phi_deg: Annotated[tuple[float, float], Ascending()] = (0.0, 360.0)
    rho_deg: Annotated[tuple[float, float], Ascending()] = (-45.0, 45.0)
    distance: Annotated[tuple[Positive, Positive], Ascending()] = (2.4, 4.0)
    distance_unit: Unit = "radii"

    def __post_init__(self) -> None:
        if self.distance_unit == "radii" and not self.distance[0] > 1.0:
            raise ValueError(f"unlearned.distance: want more than 1 object radius, got {list(self.distance)}")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges by coordinate, in radians and in ``distance_unit``."""
        phi, rho = ((math.radians(r[0]), math.radians(r[1])) for r in (self.phi_deg, self.rho_deg))
        return {"phi": phi, "rho": rho, "distance": self.distance, "magnification": (1.0, 1.0)}


def radii_in_metres(nearest: float, sizes: Mapping[str, float | None]) -> tuple[float, ...]:
    """Return the objects' radii in metres; check that cameras ``nearest`` metres away are outside the objects.

    ``sizes`` has the radius of each object, None where it is unknown.

    Raises:
        ValueError: an object has an unknown size, or the nearest camera would not be safely outside it.
    """
    unknown = [name for name, radius in sizes.items() if radius is None]
    if unknown:
        raise ValueError(
            f"distances in metres need objects of known size, but nothing gives the size of {', '.join(unknown)}: "
            "set objects.size, or give distances in object radii"
        )
    known = {name: radius for name, radius in sizes.items() if radius is not None}
    for name, radius in known.items():
        if not nearest > NEAREST * radius:
            raise ValueError(
                f"distances: a camera {nearest:g} m from {name}, of radius {radius:.3g} m, is inside it or too close; "
                f"want more than {NEAREST * radius:.3g} m"
            )
    return tuple(known.values())
