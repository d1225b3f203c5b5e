"""Several objects in an image: layers in front of each other, and boxes of what stays visible.

Each object is rendered alone and lies in a plane of its own: the nearer hides the farther, whole objects at a time.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.synthesis.boxes import boxes_from_opacity


def stacked(
    rgb: Float[Tensor, "n layers h w 3"],
    opacity: Float[Tensor, "n layers h w"],
    background: Float[Tensor, "n 3 h w"],
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n layers h w"]]:
    """Images of layers, the nearest first, over a background, and how much of each layer's opacity is visible:
    ``T_l o_l`` with ``T_l`` the product of ``1 - o`` of the layers before. ``rgb`` is premultiplied by ``opacity``.
    """
    clear = torch.ones_like(opacity[:, :1])
    before = torch.cat([clear, (1.0 - opacity).cumprod(1)], 1)
    in_front, through = before[:, :-1], before[:, -1]
    image = (in_front[..., None] * rgb).sum(1).movedim(-1, 1) + through[:, None] * background
    return image, in_front * opacity


def by_depth(
    distance: Float[Tensor, "n layers"], order: Float[Tensor, "n layers"]
) -> Int[Tensor, "n layers"]:
    """Indices of the layers, the nearest first; among equal distances by ``order``."""
    first = order.argsort(dim=1, stable=True)
    return first.gather(1, distance.gather(1, first).argsort(dim=1, stable=True))


def visible_boxes(
    opacity: Float[Tensor, "n layers h w"],
    visible: Float[Tensor, "n layers h w"],
    threshold: float,
    minimum_area: float,
    min_visibility: float,
) -> tuple[Float[Tensor, "n layers 4"], Bool[Tensor, "n layers"]]:
    """The box round each layer's visible pixels, and whether it has one: fewer than ``minimum_area`` visible pixels, or
    a smaller part than ``min_visibility`` of those that the image would show of the object alone, have none.
    """
    n, layers = opacity.shape[:2]
    boxes, present = boxes_from_opacity(visible.flatten(0, 1), threshold, minimum_area)
    alone, left = ((part > threshold).sum((-1, -2)) for part in (opacity, visible))
    present = present.view(n, layers) & (left >= min_visibility * alone)
    return boxes.view(n, layers, 4) * present[..., None], present
