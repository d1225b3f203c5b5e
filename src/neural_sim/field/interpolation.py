"""Trilinear interpolation in a packed table, with rows only for vertices of occupied cells.

An array of corners lists the eight rows of each cell. On a CPU, interpolation is one ``index_select`` and one small
batched product; 3-D ``grid_sample`` is about ten times slower and has no forward-over-reverse derivatives.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.devices import at_once

SCATTERED = 8192
"""Number of samples whose gradients are scattered into the table at once on a CPU."""

CORNERS = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
"""Offsets of a cell's eight vertices, in the order of ``trilinear_weights``."""


def trilinear_weights(fraction: Float[Tensor, "samples 3"]) -> Float[Tensor, "samples 8"]:
    """Compute weights of the eight corners for a position inside a cell, each coordinate in [0, 1]."""
    x, y, z = torch.stack([1.0 - fraction, fraction], -1).unbind(1)
    xy = x[:, :, None] * y[:, None, :]
    return (xy[..., None] * z[:, None, None, :]).flatten(1)


def corner_weights(
    x: Float[Tensor, "samples"], y: Float[Tensor, "samples"], z: Float[Tensor, "samples"]
) -> Float[Tensor, "samples 8"]:
    """Compute ``trilinear_weights`` from separate coordinates: ten times faster on a CPU, not differentiable."""
    edges = torch.stack(_bilinear(x, y))
    upper = edges * z
    weights = x.new_empty(len(x), 4, 2)
    weights[..., 1] = upper.t()
    torch.sub(edges.t(), upper.t(), out=weights[..., 0])
    return weights.flatten(1)


def trilinear_tangents(
    fraction: Float[Tensor, "samples 3"], velocities: Float[Tensor, "m samples 3"]
) -> tuple[Float[Tensor, "samples 8"], Float[Tensor, "m samples 8"]]:
    """Compute ``trilinear_weights``, and their derivatives for a fraction that moves at ``velocities``.

    Each operation runs over all samples of one coordinate, so that its memory is contiguous. The results are not
    differentiable.
    """
    x, y, z = fraction.detach().t().contiguous().unbind(0)
    edges = _bilinear(x, y)
    rates = x.new_empty(len(velocities), len(x), 8)
    for rate, velocity in zip(rates, velocities.detach(), strict=True):
        u, v, w = velocity.t().contiguous().unbind(0)
        both = torch.addcmul(u * y, v, x)
        moved = (both - u - v, v - both, u - both, both)
        for index, (edge, slope) in enumerate(zip(edges, moved, strict=True)):
            upper = torch.mul(slope, z).addcmul_(edge, w)
            rate[:, 2 * index + 1] = upper
            torch.sub(slope, upper, out=rate[:, 2 * index])
    return corner_weights(x, y, z), rates


def _bilinear(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return (1 - x)(1 - y), (1 - x) y, x (1 - y) and x y."""
    both = x * y
    low = y - both
    return 1.0 - x - low, low, x - both, both


def gather_weighted(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """Interpolate in one fused operation, several times faster than ``interpolate``, where no derivative is needed."""
    return torch.nn.functional.embedding_bag(corners, table, per_sample_weights=weights, mode="sum")


def interpolate(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """Return the weighted sum of eight rows of ``table``; differentiable in every mode."""
    rows = table.index_select(0, corners.reshape(-1)).view(*corners.shape, table.shape[1])
    return torch.bmm(weights[:, None], rows)[:, 0]


class _ScatterInterpolate(torch.autograd.Function):
    """``gather_weighted`` with a backward pass to the table only, in flat scatters of pieces that fit the cache."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(corners, weights)
        ctx.table_shape = table.shape
        return gather_weighted(table, corners, weights)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor, None, None]:
        corners, weights = ctx.saved_tensors
        (cotangent,) = cotangents
        rows, channels = ctx.table_shape
        # On a CPU, scattering single numbers is faster than scattering rows, and pieces stay in its cache.
        gradient = cotangent.new_zeros(rows * channels)
        channel = torch.arange(channels, device=cotangent.device)
        size = at_once(SCATTERED, cotangent.device)
        pieces = (part.split(size) for part in (corners, weights, cotangent))
        for corner, weight, pulled in zip(*pieces, strict=True):
            place = torch.add(channel, corner.reshape(-1, 1).long(), alpha=channels)
            gradient.scatter_add_(0, place.view(-1), (weight[..., None] * pulled[:, None]).reshape(-1))
        return gradient.view(rows, channels), None, None


def interpolate_for_training(
    table: Float[Tensor, "rows channels"],
    corners: Int[Tensor, "samples 8"],
    weights: Float[Tensor, "samples 8"],
) -> Float[Tensor, "samples channels"]:
    """Interpolate, faster in reverse mode than ``interpolate``, but differentiable in ``table`` only."""
    return _ScatterInterpolate.apply(table, corners, weights)  # pyright: ignore[reportReturnType]
