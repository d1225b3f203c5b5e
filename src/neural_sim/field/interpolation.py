"""Trilinear interpolation in a packed table: rows of occupied vertices only, found through an array of corners.

On a CPU this is one ``index_select`` and one small batched product; 3-D ``grid_sample`` is about ten times slower
and lacks forward-over-reverse derivatives.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

CORNERS = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
"""Offsets of a cell's eight vertices, in the order of ``trilinear_weights``."""


def trilinear_weights(fraction: Float[Tensor, "samples 3"]) -> Float[Tensor, "samples 8"]:
    """Weights of the eight corners for a position inside a cell, each coordinate in [0, 1]."""
    x, y, z = torch.stack([1.0 - fraction, fraction], -1).unbind(1)
    xy = x[:, :, None] * y[:, None, :]
    return (xy[..., None] * z[:, None, None, :]).flatten(1)


def trilinear_tangents(
    fraction: Float[Tensor, "samples 3"], velocities: Float[Tensor, "m samples 3"]
) -> tuple[Float[Tensor, "samples 8"], Float[Tensor, "m samples 8"]]:
    """``trilinear_weights``, and their derivatives where the fraction moves at ``velocities``.

    Corner by corner over all samples, so that every operation runs over contiguous memory. No derivative passes.
    """
    x, y, z = fraction.detach().t().contiguous().unbind(0)
    xy = _bilinear(torch.ones_like(x), x, y, x * y)
    rates = []
    for velocity in velocities.detach():
        u, v, w = velocity.t().contiguous().unbind(0)
        moved = _bilinear(torch.zeros_like(u), u, v, torch.addcmul(u * y, v, x))
        rate = moved.new_empty(4, 2, len(x))
        torch.mul(moved, z, out=rate[:, 1]).addcmul_(xy, w)
        torch.sub(moved, rate[:, 1], out=rate[:, 0])
        rates.append(rate.flatten(0, 1).t())
    weights = xy.new_empty(4, 2, len(x))
    torch.mul(xy, z, out=weights[:, 1])
    torch.sub(xy, weights[:, 1], out=weights[:, 0])
    return weights.flatten(0, 1).t().contiguous(), torch.stack(rates).contiguous()


def _bilinear(one: Tensor, x: Tensor, y: Tensor, xy: Tensor) -> Float[Tensor, "4 samples"]:
    """(1 - x)(1 - y), (1 - x) y, x (1 - y), x y from the product; or their derivatives, ``one`` being 0."""
    low_y = y - xy
    return torch.stack([one - x - low_y, low_y, x - xy, xy])


def gather_weighted(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """``interpolate`` in one fused operation, several times faster; for values only."""
    return torch.nn.functional.embedding_bag(corners, table, per_sample_weights=weights, mode="sum")


def interpolate(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """Weighted sum of eight rows of ``table``. Every derivative mode works through it."""
    rows = table.index_select(0, corners.reshape(-1)).view(*corners.shape, table.shape[1])
    return torch.bmm(weights[:, None], rows)[:, 0]


class _ScatterInterpolate(torch.autograd.Function):
    """``interpolate`` with a backward pass to the table alone, as one flat scatter instead of a row-wise one."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(corners, weights)
        ctx.table_shape = table.shape
        return interpolate(table, corners, weights)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None, None]:
        corners, weights = ctx.saved_tensors
        (cotangent,) = cotangents
        rows, channels = ctx.table_shape
        # Channel by channel: a 1-D scatter_add is several times faster on a CPU than one of rows.
        index = corners.reshape(-1).long()
        gradient = torch.zeros(channels, rows, dtype=cotangent.dtype, device=cotangent.device)
        for channel in range(channels):
            gradient[channel].scatter_add_(0, index, (weights * cotangent[:, channel, None]).reshape(-1))
        return gradient.t().contiguous(), None, None


def interpolate_for_training(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """``interpolate``, faster in reverse mode and differentiable in ``table`` only (weights are constants)."""
    return _ScatterInterpolate.apply(table, corners, weights)  # pyright: ignore[reportReturnType]
