"""From rays to pixels through any field: sample, query, composite. One place, so that training and rendering agree."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.base import RadianceField
from neural_sim.field.pixels import pixel_rays, seen_pixels
from neural_sim.field.quadrature import composite, composite_with_tangents
from neural_sim.field.samples import PackedSamples
from neural_sim.types import PinholeCamera, Rays

RAY_NUMBERS = 6
SAMPLES_AT_ONCE = 16_384
"""Samples asked for derivatives together: they keep to the cache."""


def sample_points(
    rays: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "samples 3"], Float[Tensor, "samples 3"]]:
    """Positions and directions of the samples, differentiable in the rays; the distances are constants."""
    directions = rays.directions.index_select(0, samples.ray)
    origins = rays.origins.index_select(0, samples.ray)
    return origins + directions * samples.distance[:, None], directions


def render_samples(
    field: RadianceField, rays: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Premultiplied colour and opacity of rays (rays, 3) by the quadrature on the given samples."""
    positions, directions = sample_points(rays, samples)
    sigma, rgb = field.query(positions, directions)
    return composite(sigma, rgb, samples)


def render_packed(
    field: RadianceField, rays: Rays, termination: float
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """``render_samples`` on the samples that the field itself chooses."""
    return render_samples(field, rays, field.sample(rays, termination))


@torch.no_grad()
def render_with_tangents(
    field: RadianceField,
    rays: Rays,
    rates: Rays,
    termination: float,
    samples_at_once: int = SAMPLES_AT_ONCE,
) -> tuple[Float[Tensor, "rays 4"], Float[Tensor, "n rays 4"]]:
    """Premultiplied RGBA of rays (rays, 3), and its derivatives where they move at ``rates`` (m, rays, 3).

    Derivatives by a moving light (see ``RadianceField.light_rates``) follow these m.

    One pass over the samples gives both, about ``samples_at_once`` at a time: a sample at distance t moves at
    o' + t d'. A ray has six numbers; of more
    rates than that, the derivatives by these six are taken and combined.
    """
    if len(rates.origins) > RAY_NUMBERS:
        pixels, by_number = render_with_tangents(field, rays, _unit_rates(rays), termination, samples_at_once)
        numbers = torch.cat([rates.origins, rates.directions], -1)
        moved = torch.einsum("mrk,krc->mrc", numbers, by_number[:RAY_NUMBERS])
        return pixels, torch.cat([moved, by_number[RAY_NUMBERS:]])
    samples = field.sample(rays, termination)
    # Pieces of about as many samples need the same memory wherever in an image their rays lie.
    cuts = torch.arange(0, len(samples), samples_at_once, device=samples.starts.device)[1:]
    edges = [0, *torch.searchsorted(samples.starts, cuts).tolist(), len(rays.origins)]
    parts = [
        _with_tangents(field, _rows(rays, a, b), _rows(rates, a, b), samples.of_rays(a, b))
        for a, b in pairwise(edges)
        if a < b
    ]
    return torch.cat([pixels for pixels, _ in parts]), torch.cat([moved for _, moved in parts], 1)


def _rows(rays: Rays, first: int, last: int) -> Rays:
    return Rays(rays.origins[..., first:last, :], rays.directions[..., first:last, :])


def _with_tangents(
    field: RadianceField, rays: Rays, rates: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "rays 4"], Float[Tensor, "n rays 4"]]:
    positions, directions = sample_points(rays, samples)
    turns = rates.directions.index_select(1, samples.ray)
    velocities = torch.addcmul(rates.origins.index_select(1, samples.ray), turns, samples.distance[:, None])
    queried = field.query_with_tangents(positions, directions, velocities, turns)
    return composite_with_tangents(*queried, samples)


def _unit_rates(rays: Rays) -> Rays:
    """Rays whose six numbers, origin and direction, change one at a time."""
    unit = torch.eye(RAY_NUMBERS, dtype=rays.origins.dtype, device=rays.origins.device)
    unit = unit[:, None].expand(-1, len(rays.origins), -1)
    return Rays(unit[..., :3], unit[..., 3:])


@torch.no_grad()
def render_views(
    field: RadianceField,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    termination: float,
    rays_per_chunk: int,
    cull: bool = True,
    skip_empty: bool = True,
) -> Float[Tensor, "views height width 4"]:
    """Premultiplied RGBA of whole views; chunks bound the memory and may span views.

    ``cull`` casts rays only for pixels that may see something; for ``skip_empty`` see ``RadianceField.trace``.
    """
    shape = (len(camera_to_world), camera.height, camera.width, 4)
    image = camera_to_world.new_zeros(shape).view(-1, 4)
    for seen in seen_pixels(field, camera, camera_to_world, rays_per_chunk, cull):
        rays = pixel_rays(camera, camera_to_world, seen.pixel)
        rgb, opacity = field.trace(rays, termination, seen.span, skip_empty)
        image.index_copy_(0, seen.pixel, torch.cat([rgb, opacity[:, None]], -1))
    return image.view(shape)
