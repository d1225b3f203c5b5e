"""Euclidean projections for weights that must add up to 1, such as those of lights."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def project_sum(values: Float[Tensor, "*n k"], total: float = 1.0) -> Float[Tensor, "*n k"]:
    """The nearest point of the plane ``sum(w) = total``, of either sign.

    Raises:
        ValueError: no entries, or entries that are not finite.
    """
    _check(values)
    return values - (values.mean(-1, keepdim=True) - total / values.shape[-1])


def project_simplex(values: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
    """The nearest point of the simplex ``w >= 0, sum(w) = 1`` (Held, Wolfe and Crowder 1974).

    It is ``max(v - t, 0)`` for the one t at which that adds up to 1. Only differences to the largest entry matter, and
    of those only the ones below 1 (t lies at most 1 below the largest entry), so that nothing large is ever subtracted:
    entries of any size are projected to a few roundings of 1. Differentiable where the set of positive weights does not
    change: there the derivative is ``I - 1 1^T / (positive weights)`` on that set.

    Raises:
        ValueError: no entries, or entries that are not finite.
    """
    _check(values)
    below = (values - values.amax(-1, keepdim=True).detach()).clamp_min(-1.0)
    descending = below.sort(-1, descending=True).values
    count = torch.arange(1, values.shape[-1] + 1, dtype=values.dtype, device=values.device)
    thresholds = (descending.cumsum(-1) - 1.0) / count
    positive = (descending > thresholds).sum(-1, keepdim=True)
    return (below - thresholds.gather(-1, positive - 1)).clamp_min(0.0)


def _check(values: Tensor) -> None:
    if values.ndim == 0 or values.shape[-1] == 0:
        raise ValueError(f"simplex: want at least one weight, got shape {tuple(values.shape)}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"simplex: weights must be finite, got {values.tolist()}")
