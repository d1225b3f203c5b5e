"""Masks as file formats store them: run lengths, boxes, and polygons along the edges of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from faster_coco_eval.core import mask as coco_mask
from jaxtyping import Bool, Int

Box = tuple[int, int, int, int]
STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
"""Right, down, left, up: (x, y). A boundary is walked with its pixels on the right."""


def run_lengths(mask: Bool[np.ndarray, "height width"]) -> dict[str, Any]:
    """Encode a mask as COCO's compressed run lengths, with the counts as text."""
    encoded = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(side) for side in encoded["size"]], "counts": encoded["counts"].decode("ascii")}


def mask_of(encoded: dict[str, Any]) -> Bool[np.ndarray, "height width"]:
    """Invert ``run_lengths``."""
    return coco_mask.decode(encoded).astype(bool)


def box_of(mask: Bool[np.ndarray, "height width"]) -> Box | None:
    """Return (x0, y0, x1, y1) along the edges of pixels; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def outlines(mask: Bool[np.ndarray, "height width"]) -> list[Int[np.ndarray, "_ 2"]]:
    """Trace a mask's closed outlines, each as its corners (x, y) along pixel edges, the largest first.

    Outlines of parts go clockwise in the image, those of holes counter-clockwise. Parts that touch only at a corner are
    not joined.
    """
    whole = np.pad(mask, 1).astype(np.int8)
    starts: dict[tuple[int, int], list[int]] = {}
    vertical, horizontal = np.diff(whole, axis=1), np.diff(whole, axis=0)
    # The edges with their pixel on the right, by the corner at which they begin.
    for direction, (rows, columns) in enumerate(
        (np.nonzero(horizontal == 1), np.nonzero(vertical == -1), np.nonzero(horizontal == -1),
         np.nonzero(vertical == 1))
    ):  # fmt: skip
        x = columns - 1 if direction in (0, 2) else columns
        y = rows - 1 if direction in (1, 3) else rows
        x, y = x + (direction == 2), y + (direction == 3)
        for corner in zip(x.tolist(), y.tolist(), strict=True):
            starts.setdefault(corner, []).append(direction)
    found = []
    while starts:
        first = next(iter(starts))
        corner, direction, corners = first, starts[first][0], []
        before = -1
        while True:
            ways = starts[corner]
            # Where two pixels touch at a corner, turn right to stay at the same pixel.
            direction = ways[0] if len(ways) == 1 else (before + 1) % 4 if before >= 0 else ways[0]
            ways.remove(direction)
            if not ways:
                del starts[corner]
            if direction != before:
                corners.append(corner)
            before = direction
            corner = (corner[0] + int(STEPS[direction][0]), corner[1] + int(STEPS[direction][1]))
            if corner == first and (first not in starts or _closes(starts[first], before)):
                break
        found.append(np.array(corners))
    return sorted(found, key=lambda loop: -abs(_area(loop)))


def polygon(mask: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "corners 2"]:
    """Join the outlines of a mask into one closed polygon whose inside, by the even-odd rule, is the mask.

    The polygon goes from the first outline's first corner to each other outline and back, and these ways cancel. The
    polygon of an empty mask is empty.
    """
    loops = outlines(mask)
    if not loops:
        return np.zeros((0, 2), dtype=np.int64)
    parts = [loops[0]]
    for loop in loops[1:]:
        parts += [loops[0][:1], loop, loop[:1]]
    return np.concatenate(parts) if len(parts) == 1 else np.concatenate([*parts, loops[0][:1]])


def _closes(ways: list[int], before: int) -> bool:
    """Tell whether a walk that arrives at its first corner is done although another edge begins there.

    It is done if the walk would not turn right into that edge.
    """
    return (before + 1) % 4 not in ways


def _area(loop: Int[np.ndarray, "corners 2"]) -> float:
    x, y = loop[:, 0], loop[:, 1]
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
