"""Objects over backgrounds: shifts, layers in front of each other, and boxes of what stays visible."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def composite(
    rgb: Float[Tensor, "n h w 3"], opacity: Float[Tensor, "n h w"], background: Float[Tensor, "n 3 h w"]
) -> Float[Tensor, "n 3 h w"]:
    """Compute ``rgb + (1 - opacity) * background``, with ``rgb`` premultiplied by opacity as in a radiance field."""
    if rgb.shape != (*opacity.shape, 3) or background.shape != (len(opacity), 3, *opacity.shape[1:]):
        raise ValueError(
            "composite: want rgb [n, h, w, 3], opacity [n, h, w], background [n, 3, h, w], got "
            f"{tuple(rgb.shape)}, {tuple(opacity.shape)}, {tuple(background.shape)}"
        )
    return rgb.movedim(-1, 1) + (1.0 - opacity)[:, None] * background


def draw_shift(
    n: int, fraction: float, height: int, width: int, generator: torch.Generator
) -> Int[Tensor, "n 2"]:
    """Draw shifts (right, down) in whole pixels, uniform up to ``fraction`` of width and height either way."""
    reach = torch.tensor([int(fraction * width), int(fraction * height)])
    uniform = torch.rand((n, 2), generator=generator, dtype=torch.float64)
    return (uniform * (2 * reach + 1)).floor().long() - reach


def apply_shift(image: Float[Tensor, "n h w *c"], shift: Int[Tensor, "n 2"]) -> Float[Tensor, "n h w *c"]:
    """Move every image by its own shift (right, down); pixels that enter from outside are zero."""
    if shift.shape != (len(image), 2):
        raise ValueError(f"apply_shift: want shift [{len(image)}, 2], got {tuple(shift.shape)}")
    if not shift.any():
        return image
    n, height, width = image.shape[:3]
    shift = shift.to(image.device)
    columns = torch.arange(width, device=image.device) - shift[:, :1]
    rows = torch.arange(height, device=image.device) - shift[:, 1:]
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None]
    source = rows.clamp(0, height - 1)[:, :, None] * width + columns.clamp(0, width - 1)[:, None]
    pixels = image.reshape(n, height * width, -1)
    moved = pixels.gather(1, source.reshape(n, -1, 1).expand(-1, -1, pixels.shape[-1]))
    # ``where`` instead of a product, which would spread a NaN at the image's edge.
    return torch.where(inside.reshape(n, -1, 1), moved, 0.0).reshape(image.shape)


def stacked(
    rgb: Float[Tensor, "n layers h w 3"],
    opacity: Float[Tensor, "n layers h w"],
    background: Float[Tensor, "n 3 h w"],
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n layers h w"]]:
    """Composite layers, the nearest first, over a background; ``rgb`` is premultiplied by ``opacity``.

    Each object is a plane at one depth: the nearer object hides the farther one as a whole.

    Returns:
        The images, and how much of each layer's opacity is visible: ``T_l o_l``, with ``T_l`` the product of ``1 - o``
        over the layers before.
    """
    clear = torch.ones_like(opacity[:, :1])
    before = torch.cat([clear, (1.0 - opacity).cumprod(1)], 1)
    in_front, through = before[:, :-1], before[:, -1]
    image = (in_front[..., None] * rgb).sum(1).movedim(-1, 1) + through[:, None] * background
    return image, in_front * opacity


def by_depth(
    distance: Float[Tensor, "n layers"], order: Float[Tensor, "n layers"]
) -> Int[Tensor, "n layers"]:
    """Return the indices of the layers, the nearest first; ``order`` decides among equal distances."""
    first = order.argsort(dim=1, stable=True)
    return first.gather(1, distance.gather(1, first).argsort(dim=1, stable=True))


def visible_boxes(
    opacity: Float[Tensor, "n layers h w"],
    visible: Float[Tensor, "n layers h w"],
    threshold: float,
    minimum_area: float,
    min_visibility: float,
) -> tuple[Float[Tensor, "n layers 4"], Bool[Tensor, "n layers"]]:
    """Return the box around each layer's visible pixels, and whether it has one.

    A layer has no box if it has fewer than ``minimum_area`` visible pixels, or less than the fraction
    ``min_visibility`` of the pixels that the image would show of the object alone.
    """
    n, layers = opacity.shape[:2]
    boxes, present = boxes_from_opacity(visible.flatten(0, 1), threshold, minimum_area)
    alone, left = ((part > threshold).sum((-1, -2)) for part in (opacity, visible))
    present = present.view(n, layers) & (left >= min_visibility * alone)
    return boxes.view(n, layers, 4) * present[..., None], present


def boxes_from_opacity(
    opacity: Float[Tensor, "n h w"], threshold: float = 0.5, minimum_area: float = 1.0
) -> tuple[Float[Tensor, "n 1 4"], Bool[Tensor, "n"]]:
    """Return the tight box (x0, y0, x1, y1) around pixels of opacity above ``threshold``, and whether there is one.

    Boxes run along pixel edges, so that a single pixel has a box of 1 x 1. An image whose mask has fewer than
    ``minimum_area`` pixels (or none) has no box: zeros and False. Not differentiable.
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
    """Return the first occupied index, and one past the last."""
    first = occupied.int().argmax(-1)
    last = occupied.shape[-1] - occupied.flip(-1).int().argmax(-1)
    return first, last
