"""What computes masks from the geometry of a capture's scene, and the box that says where the object is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from neural_sim.objects.capture import Capture

Direction = tuple[float, float, float]
Corners = tuple[Direction, Direction]
"""The lowest and the highest corner of a box along the axes of the capture's frame, in its unit."""
Box = list[list[float]] | None


@runtime_checkable
class SceneMaskMaker(Protocol):
    """Computes masks from photographs and cameras alone."""

    def masks(
        self, capture: Capture, up: Direction | None, box: Corners | None
    ) -> tuple[Float[Tensor, "_ _"], ...]:
        """For each of the capture's frames the opacity of the object in [0, 1], at any size.

        Raises:
            ValueError: no object found.
        """
        ...


def box_of(box: Box | Mapping[str, Box], name: str) -> Corners | None:
    """An object's box, from one for all objects or a mapping by name. Raises ``ValueError`` for what is no box."""
    given: Any = box.get(name) if isinstance(box, Mapping) else box
    if given is None:
        return None
    corners = [_corner(corner) for corner in given] if isinstance(given, (list, tuple)) else []
    if len(corners) == 2:
        low, high = corners
        if low is not None and high is not None and all(a < b for a, b in zip(low, high, strict=True)):
            return low, high
    raise ValueError(
        f"objects.box: want [[x0, y0, z0], [x1, y1, z1]] with x0 < x1, y0 < y1, z0 < z1 for {name}, got {given!r}"
    )


def _corner(corner: Any) -> Direction | None:
    if not isinstance(corner, (list, tuple)) or len(corner) != 3:
        return None
    if any(type(x) not in (int, float) or not math.isfinite(x) for x in corner):
        return None
    return float(corner[0]), float(corner[1]), float(corner[2])
