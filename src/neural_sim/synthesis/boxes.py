"""Boxes of rendered objects, from their opacity."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def boxes_from_opacity(
    opacity: Float[Tensor, "n h w"], threshold: float = 0.5, minimum_area: float = 1.0
) -> tuple[Float[Tensor, "n 1 4"], Bool[Tensor, "n"]]:
    """The tight box (x0, y0, x1, y1) round the pixels whose opacity exceeds ``threshold``, and whether there is one.

    Boxes run along pixel edges, so a single pixel gives a box of 1 x 1. An image whose mask has fewer than
    ``minimum_area`` pixels (or none) has no box: zeros and False. No derivative passes through.
    """
    if opacity.ndim != 3:
        raise ValueError(f"boxes_from_opacity: want opacity [n, h, w], got shape {tuple(opacity.shape)}")
    mask = opacity.detach() > threshold
    present = mask.sum((1, 2)) >= max(minimum_area, 1)
    x0, x1 = _span(mask.any(1))
    y0, y1 = _span(mask.any(2))
    boxes = torch.stack([x0, y0, x1, y1], -1).to(opacity.dtype) * present[:, None]
    return boxes[:, None], present


def _span(occupied: Bool[Tensor, "n s"]) -> tuple[Tensor, Tensor]:
    """First occupied index, and one past the last."""
    first = occupied.int().argmax(-1)
    last = occupied.shape[-1] - occupied.flip(-1).int().argmax(-1)
    return first, last
