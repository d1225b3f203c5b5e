"""The volume rendering quadrature on packed samples (Max 1995; NeRF, Mildenhall et al. 2020, Eq. 3), pure functions.

Sums over a ray are differences of one running sum over all samples. It runs in float64, so that a ray late in
the pack loses no digits to those before it; unlike scatters it is fast on a CPU and has both derivative modes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.base import PackedSamples


def alpha_from_sigma(
    sigma: Float[Tensor, "*samples"], width: Float[Tensor, "*samples"]
) -> Float[Tensor, "*samples"]:
    """Absorbed fraction of one sample, 1 - exp(-sigma delta), exact where sigma delta is tiny."""
    return -torch.expm1(-sigma * width)


def sum_rays(
    values: Float[Tensor, "samples channels"], samples: PackedSamples
) -> Float[Tensor, "rays channels"]:
    """Sum each ray's samples; rays without samples give zero."""
    running = torch.nn.functional.pad(values.double().cumsum(0), (0, 0, 1, 0))
    ends = running.index_select(0, samples.starts)
    return (ends[1:] - ends[:-1]).to(values.dtype)


def transmittance(sigma: Float[Tensor, "samples"], samples: PackedSamples) -> Float[Tensor, "samples"]:
    """Fraction of light that reaches each sample: exp of minus the exclusive sum of sigma delta along its ray."""
    depth = (sigma * samples.width).double()
    exclusive = depth.cumsum(0) - depth
    # A sentinel keeps the start of a last ray without samples inside the array; its value is never used.
    at_start = torch.nn.functional.pad(exclusive, (0, 1)).index_select(0, samples.starts[:-1])
    return torch.exp(at_start.index_select(0, samples.ray) - exclusive).to(sigma.dtype)


def render_weights(sigma: Float[Tensor, "samples"], samples: PackedSamples) -> Float[Tensor, "samples"]:
    """Contribution of each sample to its pixel, T alpha. They sum to the ray's opacity."""
    return transmittance(sigma, samples) * alpha_from_sigma(sigma, samples.width)


def composite(
    sigma: Float[Tensor, "samples"], rgb: Float[Tensor, "samples 3"], samples: PackedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Premultiplied colour and opacity of each ray. There is no last infinite interval: what passes, passes."""
    weights = render_weights(sigma, samples)[:, None]
    pixels = sum_rays(torch.cat([weights * rgb, weights], -1), samples)
    return pixels[:, :3], pixels[:, 3]
