"""RetinaNet's two losses, elementwise and smooth, so that their Hessians say what a finite step sees."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def focal_loss(
    logits: Float[Tensor, "*shape"], targets: Float[Tensor, "*shape"], alpha: float, gamma: float
) -> Float[Tensor, "*shape"]:
    """Sigmoid focal loss per element (Lin et al. 2017, Eq. 5); ``targets`` are 0 or 1.

    Written with softplus instead of binary_cross_entropy_with_logits: it is stable for large logits and has
    derivatives of every order in forward and reverse mode.
    """
    sign = 2 * targets - 1
    cross_entropy = F.softplus(-sign * logits)
    miss = torch.sigmoid(-sign * logits)
    alpha_t = alpha * targets + (1 - alpha) * (1 - targets)
    return alpha_t * miss**gamma * cross_entropy


def box_loss(residual: Float[Tensor, "*shape"], kind: str, delta: float) -> Float[Tensor, "*shape"]:
    """Loss of an encoded box coordinate's error, per element.

    ``pseudo_huber`` is delta (sqrt(1 + (r / delta)^2) - 1): quadratic within ``delta``, slope 1 far out like
    ``l1``, smooth everywhere. ``l1`` is torchvision's default and has no curvature.
    """
    if kind == "l1":
        return residual.abs()
    square = (residual / delta) ** 2
    # sqrt(1 + square) - 1, without the difference that cancels every digit of a small residual.
    return delta * square / (torch.sqrt(1 + square) + 1)


def proximal_loss(
    params: Mapping[str, Tensor], anchor: Mapping[str, Tensor], proximal: float
) -> Float[Tensor, ""]:
    """``proximal / 2 |params - anchor|^2`` over the names of ``params``; no derivative by the anchor."""
    squares = [(value - anchor[name].detach()).square().sum() for name, value in params.items()]
    return 0.5 * proximal * torch.stack(squares).sum()
