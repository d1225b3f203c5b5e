"""Triangulation of polygons."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def clipped(corners: Float[np.ndarray, "n 3"]) -> list[tuple[int, int, int]]:
    """Cut a planar polygon into triangles: as a fan if it is convex, otherwise by ear clipping."""
    count = len(corners)
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners - corners[0], following - corners[0]).sum(0)  # twice the area vector
    turns = np.cross(corners - np.roll(corners, 1, axis=0), following - corners) @ normal
    if not (turns < 0.0).any() or not np.isfinite(turns).all():
        return [(0, i, i + 1) for i in range(1, count - 1)]
    left, made = list(range(count)), []
    while len(left) > 3:
        for place in range(len(left)):
            a, b, c = left[place - 1], left[place], left[(place + 1) % len(left)]
            others = corners[[i for i in left if i not in (a, b, c)]]
            if _is_ear(corners[a], corners[b], corners[c], others, normal):
                break
        else:
            place = 0  # a polygon that crosses itself may have no ears
        made.append((left[place - 1], left[place], left[(place + 1) % len(left)]))
        del left[place]
    return [*made, (left[0], left[1], left[2])]


def _is_ear(a: np.ndarray, b: np.ndarray, c: np.ndarray, others: np.ndarray, normal: np.ndarray) -> bool:
    if np.cross(b - a, c - b) @ normal <= 0.0:
        return False
    inside = np.ones(len(others), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.cross(end - start, others - start) @ normal >= 0.0
    return not inside.any()
