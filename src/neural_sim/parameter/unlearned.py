"""Coordinates that no parameter draws: their uniform ranges, and the unit of the camera's distance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from neural_sim.ranges import Ascending, Positive, validated

Unit = Literal["radii", "metres"]
"""Each object's own radius, or metres, which need objects of known size."""
NEAREST = 1.05
"""In object radii: any closer, a camera is inside the object."""


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
        """Ranges by coordinate, in radians and in the unit of distances."""
        phi, rho = ((math.radians(r[0]), math.radians(r[1])) for r in (self.phi_deg, self.rho_deg))
        return {"phi": phi, "rho": rho, "distance": self.distance, "magnification": (1.0, 1.0)}


def radii_in_metres(nearest: float, sizes: Mapping[str, float | None]) -> tuple[float, ...]:
    """Return the radii in metres of the objects ``sizes``, and check that cameras ``nearest`` metres away are outside.

    Raises:
        ValueError: an object has an unknown size, or the nearest camera would be inside it.
    """
    unknown = [name for name, radius in sizes.items() if radius is None]
    if unknown:
        raise ValueError(
            f"distances in metres need objects of known size, and nothing says that of {', '.join(unknown)}: "
            "set objects.size, or give distances in object radii"
        )
    known = {name: radius for name, radius in sizes.items() if radius is not None}
    for name, radius in known.items():
        if not nearest > NEAREST * radius:
            raise ValueError(
                f"distances: a camera {nearest:g} m from {name}, of radius {radius:.3g} m, is inside it; want more "
                f"than {NEAREST * radius:.3g} m"
            )
    return tuple(known.values())
