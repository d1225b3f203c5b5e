"""Boxes of rendered objects, from their opacity, and how they move with it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SMALLEST_SLOPE = 0.05
"""Smallest change of opacity per pixel by which an edge's derivative is divided."""


def boxes_from_opacity(
    opacity: Float[Tensor, "n h w"],
    threshold: float = 0.5,
    minimum_area: float = 1.0,
    differentiable: bool = False,
) -> tuple[Float[Tensor, "n 1 4"], Bool[Tensor, "n"]]:
    """The tight box (x0, y0, x1, y1) round the pixels whose opacity exceeds ``threshold``, and whether there is one.

    Boxes run along pixel edges, so a single pixel gives a box of 1 x 1. An image whose mask has fewer than
    ``minimum_area`` pixels (or none) has no box: zeros and False. ``differentiable``: the boxes, whose values are the
    same, move with ``opacity`` as :func:`subpixel_edges` do; otherwise no derivative passes through.
    """
    if opacity.ndim != 3:
        raise ValueError(f"boxes_from_opacity: want opacity [n, h, w], got shape {tuple(opacity.shape)}")
    mask = opacity.detach() > threshold
    present = mask.sum((1, 2)) >= max(minimum_area, 1)
    x0, x1 = _span(mask.any(1))
    y0, y1 = _span(mask.any(2))
    boxes = torch.stack([x0, y0, x1, y1], -1).to(opacity.dtype) * present[:, None]
    if differentiable:
        moving = torch.where(present[:, None], subpixel_edges(opacity, threshold), 0.0)
        boxes = boxes + (moving - moving.detach())
    return boxes[:, None], present


def subpixel_edges(opacity: Float[Tensor, "n h w"], threshold: float = 0.5) -> Float[Tensor, "n 4"]:
    """Sub-pixel (x0, y0, x1, y1) of boxes in pixels: where opacity, linear between pixel centres along rows and
    columns, first and last reaches ``threshold``.

    The derivative is the implicit function theorem's at the outermost crossing: where o(x, V) = threshold,
    dx/dV = -(do/dV) / (do/dx). It is exact for the outermost row's (column's) own crossing; the outline between rows
    is not seen, which for an outline of radius R pixels leaves out at most 0.5 / R of the motion along the edge, and
    an outline much sharper than a pixel is followed on average over its places within a pixel only. It is undefined
    where the outermost pixel changes (a corner that turns, a part that appears): there it is the present pixel's, one
    side's. An edge that the frame clips is the frame's and does not move; where opacity rises by less than
    ``SMALLEST_SLOPE`` per pixel the edge has no definite place, and its derivative is capped.

    Images without a pixel above the threshold have edges at 0 that do not move.
    """
    height, width = opacity.shape[1:]
    across = opacity.transpose(1, 2)
    left, right = _first_crossing(opacity, threshold), _first_crossing(opacity.flip(-1), threshold)
    top, bottom = _first_crossing(across, threshold), _first_crossing(across.flip(-1), threshold)
    some = (opacity.detach() > threshold).any(-1).any(-1)
    position = torch.stack([left, top, width - right, height - bottom], -1)
    return torch.where(some[:, None], position, 0.0)


def _first_crossing(opacity: Float[Tensor, "n h w"], threshold: float) -> Float[Tensor, "n"]:
    """Smallest x at which any row reaches the threshold."""
    values = opacity.detach()
    images = torch.arange(len(values), device=values.device)
    column = (values > threshold).any(1).int().argmax(-1)
    before = (column - 1).clamp_min(0)
    within, outside = values[images, :, column], values[images, :, before]
    rise = within - outside
    # How far outside the pixel's centre a row crosses, as a fraction of a pixel; rows below the threshold do not.
    fraction = torch.where(within > threshold, (within - threshold) / rise.clamp_min(1e-12), -1.0)
    fraction, row = fraction.max(-1)
    slope = rise[images, row]
    inner, outer = opacity[images, row, column], opacity[images, row, before]
    along = -((1.0 - fraction) * inner + fraction * outer) / slope.clamp_min(SMALLEST_SLOPE)
    edge = column + 0.5 - fraction + (along - along.detach())
    return torch.where(column == 0, 0.0, edge)


def _span(occupied: Bool[Tensor, "n s"]) -> tuple[Tensor, Tensor]:
    """First occupied index, and one past the last."""
    first = occupied.int().argmax(-1)
    last = occupied.shape[-1] - occupied.flip(-1).int().argmax(-1)
    return first, last
