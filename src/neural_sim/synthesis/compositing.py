"""Objects over backgrounds, and shifts within the image. Plain tensor algebra, differentiable any number of times."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def composite(
    rgb: Float[Tensor, "n h w 3"], opacity: Float[Tensor, "n h w"], background: Float[Tensor, "n 3 h w"]
) -> Float[Tensor, "n 3 h w"]:
    """``rgb + (1 - opacity) * background``, with ``rgb`` premultiplied by opacity as a radiance field gives it."""
    if rgb.shape != (*opacity.shape, 3) or background.shape != (len(opacity), 3, *opacity.shape[1:]):
        raise ValueError(
            "composite: want rgb [n, h, w, 3], opacity [n, h, w], background [n, 3, h, w], got "
            f"{tuple(rgb.shape)}, {tuple(opacity.shape)}, {tuple(background.shape)}"
        )
    return rgb.movedim(-1, 1) + (1.0 - opacity)[:, None] * background


def draw_shift(
    n: int, fraction: float, height: int, width: int, generator: torch.Generator
) -> Int[Tensor, "n 2"]:
    """Shifts (right, down) in whole pixels, uniform in +- ``fraction`` of width and height."""
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"shift must lie in [0, 1] (a fraction of the image's size), got {fraction}")
    reach = torch.tensor([int(fraction * width), int(fraction * height)])
    uniform = torch.rand((n, 2), generator=generator, dtype=torch.float64)
    return (uniform * (2 * reach + 1)).floor().long() - reach


def apply_shift(image: Float[Tensor, "n h w *c"], shift: Int[Tensor, "n 2"]) -> Float[Tensor, "n h w *c"]:
    """Move every image by its own (right, down); what comes in from outside is zero."""
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
    # where, not a product: a NaN at the image's edge must not enter from outside.
    return torch.where(inside.reshape(n, -1, 1), moved, 0.0).reshape(image.shape)
