"""From many samples a pixel to one: averaging colour and opacity without dark or light seams."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32


def straight_alpha(
    premultiplied: Float32[np.ndarray, "big_height big_width 4"], factor: int
) -> Float32[np.ndarray, "height width 4"]:
    """Average ``factor`` x ``factor`` premultiplied RGBA samples, then divide colour by alpha (0 where alpha is 0).

    Straight colours must not be averaged themselves: the colour of an empty sample would count. NumPy rather than
    torch: torch's threads wait for OpenGL's software rasteriser's and lose 20 ms an image.
    """
    if factor > 1:
        height, width = premultiplied.shape[0] // factor, premultiplied.shape[1] // factor
        pixels = np.zeros((height, width, 4), dtype=np.float32)
        for row in range(factor):
            for column in range(factor):
                pixels += premultiplied[row::factor, column::factor]
        pixels /= factor * factor
    else:
        pixels = premultiplied.copy()
    alpha = pixels[..., 3:]
    pixels[..., :3] = np.where(alpha > 0.0, np.clip(pixels[..., :3] / np.maximum(alpha, 1e-8), 0.0, 1.0), 0.0)
    return pixels
