"""Samples along rays without padding, and volume rendering by quadrature over them, as pure functions.

The quadrature is Max's (1995; NeRF, Mildenhall et al. 2020, Eq. 3). Sums over a ray, except in ``_segment_sum``,
are differences of one running sum over all samples, which has both derivative modes. The running sum is in float64, and
no sample counts for more than ``OPAQUE_DEPTH``, so that rays late in the pack keep their precision: the error for N
samples is at most N times the float64 eps times the sum of their counted depths.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.types import Rays

OPAQUE_DEPTH = 50.0
"""Optical depth of one sample behind which nothing is visible: exp(-50) = 2e-22 vanishes against 1 even in float64."""


@dataclass(frozen=True)
class PackedSamples:
    """Samples of many rays without padding, sorted by ray and then by distance (the layout of nerfacc).

    ``ray`` is the index of each sample's ray; ``distance`` is along the ray's unit direction in object radii;
    ``width`` is the length of ray that the sample represents. Ray r owns the samples ``starts[r]:starts[r + 1]``.
    """

    ray: Int[Tensor, "samples"]
    distance: Float[Tensor, "samples"]
    width: Float[Tensor, "samples"]
    starts: Int[Tensor, "rays_plus_one"]

    def __len__(self) -> int:
        return self.ray.shape[0]

    def of_rays(self, first: int, last: int, begin: int, end: int) -> PackedSamples:
        """Return the samples ``begin`` to ``end`` - 1, which belong to rays ``first`` to ``last`` - 1, numbered from 0.

        ``begin`` and ``end`` could be read from ``starts``, but that would make the host wait for the device once per
        batch.
        """
        return PackedSamples(
            self.ray[begin:end] - first,
            self.distance[begin:end],
            self.width[begin:end],
            self.starts[first : last + 1] - begin,
        )


@dataclass(frozen=True)
class Span:
    """Distances, in object radii, between which each ray may meet something; it meets nothing where near > far."""

    near: Float[Tensor, "rays"]
    far: Float[Tensor, "rays"]

    def select(self, index: Int[Tensor, "some"]) -> Span:
        """Return the spans of some rays."""
        return Span(self.near.index_select(0, index), self.far.index_select(0, index))


def sample_points(
    rays: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "samples 3"], Float[Tensor, "samples 3"]]:
    """Return positions and directions of the samples, differentiable in the rays; the distances are constants."""
    directions = rays.directions.index_select(0, samples.ray)
    origins = rays.origins.index_select(0, samples.ray)
    return origins + directions * samples.distance[:, None], directions


def alpha_from_sigma(
    sigma: Float[Tensor, "*samples"], width: Float[Tensor, "*samples"]
) -> Float[Tensor, "*samples"]:
    """Compute the fraction that one sample absorbs, 1 - exp(-sigma delta), exact even for tiny sigma delta."""
    return -torch.expm1(-sigma * width)


def sum_rays(
    values: Float[Tensor, "samples channels"], samples: PackedSamples
) -> Float[Tensor, "rays channels"]:
    """Sum the values of each ray's samples; 0 for rays without samples."""
    running = torch.nn.functional.pad(_running(values.double()), (0, 0, 1, 0))
    ends = running.index_select(0, samples.starts)
    return (ends[1:] - ends[:-1]).to(values.dtype)


def _running(values: Float[Tensor, "samples channels"]) -> Float[Tensor, "samples channels"]:
    """Compute running sums over samples, channel by channel except on a CPU.

    CUDA accumulates the rows of a matrix one after the other, but the numbers of a vector in parallel.
    """
    if values.device.type == "cpu":
        return values.cumsum(0)
    return torch.stack([channel.cumsum(0) for channel in values.unbind(-1)], -1)


def transmittance(sigma: Float[Tensor, "samples"], samples: PackedSamples) -> Float[Tensor, "samples"]:
    """Compute the fraction of light that reaches each sample: exp of minus the sum of sigma delta before it."""
    depth = (sigma * samples.width).clamp_max(OPAQUE_DEPTH)
    return torch.exp(-_exclusive(depth.double(), samples)).to(sigma.dtype)


def render_weights(sigma: Float[Tensor, "samples"], samples: PackedSamples) -> Float[Tensor, "samples"]:
    """Compute each sample's contribution to its pixel, T alpha. They sum to the ray's opacity."""
    return transmittance(sigma, samples) * alpha_from_sigma(sigma, samples.width)


def composite(
    sigma: Float[Tensor, "samples"], rgb: Float[Tensor, "samples 3"], samples: PackedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Compute premultiplied colour and opacity of each ray. The last interval is finite, so light may pass through."""
    weights = render_weights(sigma, samples)[:, None]
    pixels = sum_rays(torch.cat([weights * rgb, weights], -1), samples)
    return pixels[:, :3], pixels[:, 3]


def composite_with_tangents(
    sigma: Float[Tensor, "samples"],
    rgb: Float[Tensor, "samples 3"],
    sigma_rates: Float[Tensor, "m samples"],
    rgb_rates: Float[Tensor, "n samples 3"],
    samples: PackedSamples,
) -> tuple[Float[Tensor, "rays 4"], Float[Tensor, "n rays 4"]]:
    """Compute ``composite`` as RGBA, and its derivatives for densities and colours that change at the given rates.

    Rates beyond the m rates of density change only colour; their derivatives of opacity are exactly 0. With
    tau = sigma delta and D its exclusive sum along the ray, the weight T alpha changes at the rate
    T (exp(-tau) tau' - alpha D'). Distances and widths are constants.
    """
    depth, weights, passed = _passage(sigma, samples)
    parts = [weights[:, None] * rgb, weights[:, None]]
    for sigma_rate, rgb_rate in zip(sigma_rates, rgb_rates[: len(sigma_rates)], strict=True):
        depth_rate = sigma_rate * samples.width
        counted = depth_rate.masked_fill(depth > OPAQUE_DEPTH, 0.0)
        rate = passed * depth_rate - weights * _exclusive(counted, samples)
        parts += [torch.addcmul(rate[:, None] * rgb, weights[:, None], rgb_rate), rate[:, None]]
    parts += [weights[:, None] * rgb_rate for rgb_rate in rgb_rates[len(sigma_rates) :]]
    pixels = sum_rays(torch.cat(parts, -1), samples)
    moved, lit = pixels.split([4 * (1 + len(sigma_rates)), 3 * (len(rgb_rates) - len(sigma_rates))], -1)
    moved, lit = moved.unflatten(-1, (-1, 4)), torch.nn.functional.pad(lit.unflatten(-1, (-1, 3)), (0, 1))
    return moved[:, 0], torch.cat([moved[:, 1:], lit], 1).movedim(1, 0)


def composite_with_gradient(
    sigma: Float[Tensor, "samples"],
    rgb: Float[Tensor, "samples 3"],
    sigma_rates: Float[Tensor, "m samples"],
    rgb_rates: Float[Tensor, "n samples 3"],
    samples: PackedSamples,
) -> tuple[
    Float[Tensor, "rays 4"], Float[Tensor, "3 rays 4"], Float[Tensor, "3 rays 4"], Float[Tensor, "q rays 3"]
]:
    """Compute ``composite`` as RGBA, and its derivatives.

    The first three rates are the derivatives with respect to x, y and z. The other q = n - 3 change only colour; their
    densities, if any, are ignored. The derivatives returned are those with respect to a shift of all samples of a ray
    along x, y or z; those with respect to such a shift in proportion to the samples' distances; and those of colour
    alone at the q other rates.

    Density adds a sample's own colour, as far as light passes through the sample, and hides what is behind it: with
    tau = sigma delta, the pixel's derivative with respect to tau is T exp(-tau) c - sum_{j behind} w_j c_j.
    """
    depth, weights, passed = _passage(sigma, samples)
    weights = weights[:, None]
    colour = torch.nn.functional.pad(rgb, (0, 1), value=1.0)
    running = torch.nn.functional.pad(_running((weights * colour).double()), (0, 0, 1, 0))
    ends = running.index_select(0, samples.starts)
    behind = (ends[1:].index_select(0, samples.ray) - running[1:]).to(sigma.dtype)
    behind = behind.masked_fill((depth > OPAQUE_DEPTH)[:, None], 0.0)
    by_depth = torch.addcmul(-behind, passed[:, None], colour) * samples.width[:, None]
    gradient = sigma.new_empty(len(sigma), 3, 4)
    for axis in range(3):
        torch.mul(by_depth, sigma_rates[axis][:, None], out=gradient[:, axis])
        gradient[:, axis, :3].addcmul_(weights, rgb_rates[axis])
    gradient = gradient.flatten(1)
    pixels = (ends[1:] - ends[:-1]).to(sigma.dtype)
    summed = _segment_sum(gradient, samples), _segment_sum(gradient, samples, samples.distance)
    by_origin, by_direction = (part.unflatten(1, (3, 4)).movedim(1, 0) for part in summed)
    of_colour = pixels.new_zeros(len(rgb_rates) - 3, len(pixels), 3)
    for out, rate in zip(of_colour, rgb_rates[3:], strict=True):
        out.copy_(_segment_sum(rate, samples, weights[:, 0]))
    return pixels, by_origin, by_direction, of_colour


def _passage(
    sigma: Float[Tensor, "samples"], samples: PackedSamples
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples"], Float[Tensor, "samples"]]:
    """Return every sample's optical depth, its weight, and the transmittance behind it."""
    depth, reached = sigma * samples.width, transmittance(sigma, samples)
    return depth, reached * alpha_from_sigma(sigma, samples.width), reached * torch.exp(-depth)


def _segment_sum(
    values: Float[Tensor, "samples channels"],
    samples: PackedSamples,
    factors: Float[Tensor, "samples"] | None = None,
) -> Float[Tensor, "rays channels"]:
    """Return each ray's sum, in the values' own dtype, where no derivative is needed."""
    every = torch.arange(len(values), device=values.device)
    return torch.nn.functional.embedding_bag(
        every, values, samples.starts[:-1], per_sample_weights=factors, mode="sum"
    )


def _exclusive(values: Float[Tensor, "samples"], samples: PackedSamples) -> Float[Tensor, "samples"]:
    """Return the sum of the values before each sample along its ray."""
    wide = values.double()
    exclusive = wide.cumsum(0) - wide
    # Padding keeps the start of a last ray without samples inside the array; its value is never used.
    at_start = torch.nn.functional.pad(exclusive, (0, 1)).index_select(0, samples.starts[:-1])
    return (exclusive - at_start.index_select(0, samples.ray)).to(values.dtype)
