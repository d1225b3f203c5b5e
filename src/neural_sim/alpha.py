"""Images with opacity: straight and premultiplied colour, and a white background."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def premultiplied(rgba: Float[Tensor, "*pixels 4"]) -> Float[Tensor, "*pixels 4"]:
    """Convert straight alpha, as views have it, to premultiplied alpha, which renders have and averages need."""
    alpha = rgba[..., 3:]
    return torch.cat([rgba[..., :3] * alpha, alpha], -1)


def over_white(image: Float[Tensor, "*pixels 4"]) -> Float[Tensor, "*pixels 3"]:
    """Composite premultiplied RGBA over a white background."""
    return image[..., :3] + (1.0 - image[..., 3:])
