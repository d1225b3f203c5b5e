"""From many samples a pixel to one: averaging colour and opacity without dark or light seams."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def straight_alpha(
    premultiplied: Float[Tensor, "big_height big_width 4"], factor: int
) -> Float[Tensor, "height width 4"]:
    """Average ``factor`` x ``factor`` premultiplied RGBA samples, then divide colour by alpha (0 where alpha is 0).

    Straight colours must not be averaged themselves: the colour of an empty sample would count.
    """
    height, width = premultiplied.shape[0] // factor, premultiplied.shape[1] // factor
    pixels = premultiplied.reshape(height, factor, width, factor, 4).mean((1, 3))
    alpha = pixels[..., 3:]
    colour = pixels[..., :3] / alpha.clamp_min(1e-8)
    result = pixels.clone()
    result[..., :3] = (colour * (alpha > 0)).clamp(0.0, 1.0)
    return result
