"""The unit of the camera's distance: each object's own radius, or metres for objects whose size is known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

Unit = Literal["radii", "metres"]
NEAREST = 1.05
"""Object radii: a camera any closer is inside the object."""


def check_unit(unit: str, key: str) -> None:
    """Raises ``ValueError`` for a unit that there is not."""
    if unit not in get_args(Unit):
        raise ValueError(f"{key} must be one of {get_args(Unit)}, got {unit!r}")


def radii_in_metres(nearest: float, sizes: Mapping[str, float | None]) -> tuple[float, ...]:
    """The radii (metres) of ``sizes``, by object, for cameras no nearer than ``nearest`` metres.

    Raises:
        ValueError: an object of unknown size, or one that the nearest camera would be inside of.
    """
    unknown = [name for name, radius in sizes.items() if radius is None]
    if unknown:
        raise ValueError(
            f"distances in metres want objects of known size, and nothing says that of {', '.join(unknown)}: "
            "set objects.size, or give distances in object radii"
        )
    known = {name: radius for name, radius in sizes.items() if radius is not None}
    for name, radius in known.items():
        if not nearest > NEAREST * radius:
            raise ValueError(
                f"distances: a camera {nearest:g} m from {name}, of radius {radius:.3g} m, is inside of it; want more "
                f"than {NEAREST * radius:.3g} m"
            )
    return tuple(known.values())
