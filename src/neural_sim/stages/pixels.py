"""Images in 8 bits, as the store keeps them."""

from __future__ import annotations

import torch
from torch import Tensor


def to_bytes(images: Tensor) -> Tensor:
    """[0, 1] to 0..255, on the CPU."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def from_bytes(images: Tensor) -> Tensor:
    """Inverse of :func:`to_bytes` up to its 8 bits, float32."""
    return images.to(torch.float32) / 255
