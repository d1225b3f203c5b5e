"""Trilinear look-up in a texture's mip pyramid, following OpenGL's rules."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


class Pyramid:
    """A texture and its halvings; ``sample`` blends the two levels next to the wanted footprint."""

    def __init__(self, texture: UInt8[np.ndarray, "h w 3"]) -> None:
        height, width = texture.shape[:2]
        self.texels = height * width
        self._levels = [np.asarray(texture, dtype=np.uint8)]
        image = Image.fromarray(self._levels[0])
        while max(width, height) > 1:
            width, height = max(width // 2, 1), max(height // 2, 1)
            image = image.resize((width, height), Image.Resampling.BOX)
            self._levels.append(np.asarray(image))

    def sample(self, uv: Float[np.ndarray, "n 2"], level: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Colours in [0, 1]; ``uv`` wraps, v upwards; ``level`` is log2 of texels a sample, 0 or less: full size."""
        level = np.clip(level, 0.0, len(self._levels) - 1.0)
        low = np.floor(level).astype(np.int64)
        part = (level - low)[:, None]
        colour = np.zeros((len(uv), 3))
        for number in np.unique(np.concatenate([low, low + 1])):
            weight = np.where(
                low[:, None] == number, 1.0 - part, np.where(low[:, None] + 1 == number, part, 0.0)
            )
            rows = np.flatnonzero(weight[:, 0] > 0.0)
            if len(rows):
                colour[rows] += weight[rows] * _bilinear(self._levels[number], uv[rows])
        return colour / 255.0


def _bilinear(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    left, right = x0 % width, (x0 + 1) % width
    top, bottom = y0 % height, (y0 + 1) % height
    upper = texture[top, left] * (1.0 - fx) + texture[top, right] * fx
    lower = texture[bottom, left] * (1.0 - fx) + texture[bottom, right] * fx
    return upper * (1.0 - fy) + lower * fy
