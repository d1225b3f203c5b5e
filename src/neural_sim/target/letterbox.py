"""Photographs of any size brought to one size without distortion, and their boxes with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

GREY = 0.5


@dataclass(frozen=True)
class Letterbox:
    """Where a photograph of ``width`` x ``height`` lies in the new image (pixels)."""

    width: int
    height: int
    left: int
    top: int
    inner_width: int
    inner_height: int

    def boxes(self, boxes: Float[Tensor, "b 4"]) -> Float[Tensor, "b 4"]:
        """(x0, y0, x1, y1) of the photograph, clipped to it, in the new image."""
        size, inner, offset = self._sides(boxes)
        return torch.minimum(boxes.clamp_min(0.0), size) * (inner / size) + offset

    def of_photo(self, boxes: Float[Tensor, "b 4"]) -> Float[Tensor, "b 4"]:
        """(x0, y0, x1, y1) of the new image in the photograph, clipped to it: the inverse of :meth:`boxes`."""
        size, inner, offset = self._sides(boxes)
        return torch.minimum(((boxes - offset) * (size / inner)).clamp_min(0.0), size)

    def _sides(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Width and height, twice, of the photograph and of its part of the new image, and where that begins."""
        size = like.new_tensor([self.width, self.height, self.width, self.height])
        inner = like.new_tensor([self.inner_width, self.inner_height] * 2)
        return size, inner, like.new_tensor([self.left, self.top] * 2)


def letterbox(
    photo: Image.Image, height: int, width: int
) -> tuple[Float[Tensor, "3 height width"], Letterbox]:
    """The photograph as large as fits, centred on grey; values in [0, 1]."""
    scale = min(width / photo.width, height / photo.height)
    inner_width = max(1, min(width, round(scale * photo.width)))
    inner_height = max(1, min(height, round(scale * photo.height)))
    left, top = (width - inner_width) // 2, (height - inner_height) // 2
    resized = photo.convert("RGB").resize((inner_width, inner_height), Image.Resampling.BILINEAR)
    image = torch.full((3, height, width), GREY)
    pixels = torch.from_numpy(np.asarray(resized, dtype=np.float32) / 255.0).movedim(-1, 0)
    image[:, top : top + inner_height, left : left + inner_width] = pixels
    return image, Letterbox(photo.width, photo.height, left, top, inner_width, inner_height)
