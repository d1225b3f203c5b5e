"""Render rays and whole views of any field (sample, query, composite), with derivatives."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import pixel_rays
from neural_sim.field.base import RadianceField
from neural_sim.field.extinction import Surface
from neural_sim.field.pixels import seen_pixels
from neural_sim.field.quadrature import (
    PackedSamples,
    composite,
    composite_with_gradient,
    composite_with_tangents,
    sample_points,
)
from neural_sim.types import PinholeCamera, Rays

FEW = 2
"""Largest number of rates that are propagated one by one through the samples; more than that share the derivatives with
respect to origin and direction."""
SAMPLES_AT_ONCE = 16_384
"""Number of samples that are differentiated together on a CPU, so that they fit its cache."""


def render_samples(
    field: RadianceField, rays: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Compute premultiplied colour and opacity of rays (rays, 3) by quadrature on the given samples."""
    positions, directions = sample_points(rays, samples)
    sigma, rgb = field.query(positions, directions)
    return composite(sigma, rgb, samples)


def render_packed(
    field: RadianceField, rays: Rays, termination: float
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
    """Render like ``render_samples``, on the samples that the field itself chooses."""
    return render_samples(field, rays, field.sample(rays, termination))


@torch.no_grad()
def render_with_tangents(
    field: RadianceField, rays: Rays, rates: Rays, termination: float, samples_at_once: int = SAMPLES_AT_ONCE
) -> tuple[Float[Tensor, "rays 4"], Float[Tensor, "n rays 4"]]:
    """Compute premultiplied RGBA of rays (rays, 3), and derivatives for rays moving at ``rates`` (m, rays, 3).

    The derivatives for a changing light (see ``RadianceField.light_rates``) follow these m.

    One pass over the samples, about ``samples_at_once`` at a time, gives pixels and derivatives: a sample at distance t
    moves at o' + t d'. Many rates cost little more than a few (see ``_by_ray_numbers``).
    """
    samples = field.sample(rays, termination)
    differentiate = _with_tangents if len(rates.origins) <= FEW else _by_ray_numbers
    # Pieces with about equal numbers of samples need the same memory, wherever in an image their rays lie.
    cuts = torch.arange(0, len(samples), samples_at_once, device=samples.starts.device)[1:]
    first = torch.searchsorted(samples.starts, cuts)
    inner = torch.stack([first, samples.starts.index_select(0, first)], -1).tolist()
    edges = [(0, 0), *inner, (len(rays.origins), len(samples))]
    parts = [
        differentiate(field, _rows(rays, a, b), _rows(rates, a, b), samples.of_rays(a, b, begin, end))
        for (a, begin), (b, end) in pairwise(edges)
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


def _by_ray_numbers(
    field: RadianceField, rays: Rays, rates: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "rays 4"], Float[Tensor, "n rays 4"]]:
    """Render like ``_with_tangents``, through the spatial derivatives at each sample.

    Summed along a ray, they are the pixel's derivatives with respect to the ray's origin; weighted by distance, those
    with respect to its direction.
    """
    positions, directions = sample_points(rays, samples)
    unit = torch.eye(3, dtype=positions.dtype, device=positions.device)[:, None].expand(-1, len(samples), -1)
    zeros = torch.zeros_like(unit)
    moves, turns = (torch.cat([unit, zeros]), torch.cat([zeros, unit])) if field.directed else (unit, zeros)
    queried = field.query_with_tangents(positions, directions, moves, turns)
    pixels, by_origin, by_direction, of_colour = composite_with_gradient(*queried, samples)
    if field.directed:
        by_turn, of_colour = of_colour.split([3, len(of_colour) - 3])
        by_direction = by_direction + torch.nn.functional.pad(by_turn, (0, 1))
    moved = torch.einsum("mri,irc->mrc", rates.origins, by_origin)
    moved += torch.einsum("mri,irc->mrc", rates.directions, by_direction)
    return pixels, torch.cat([moved, torch.nn.functional.pad(of_colour, (0, 1))])


@torch.no_grad()
def render_views(
    field: RadianceField,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    termination: float,
    rays_per_chunk: int,
    cull: bool = True,
    skip_empty: bool = True,
    surfaces: bool = False,
) -> Float[Tensor, "views height width channels"]:
    """Render premultiplied RGBA of whole views; chunks bound the memory and may span views.

    ``cull`` casts rays only for pixels that may see something; for ``skip_empty``, see ``RadianceField.trace``. With
    ``surfaces``, a fifth channel has the distance along the ray at which half of the light is lost (0: nowhere).
    """
    shape = (len(camera_to_world), camera.height, camera.width, 4 + surfaces)
    image = camera_to_world.new_zeros(shape).view(-1, shape[-1])
    for seen in seen_pixels(field, camera, camera_to_world, rays_per_chunk, cull):
        rays = pixel_rays(camera, camera_to_world, seen.pixel)
        surface = Surface(len(seen.pixel), image) if surfaces else None
        rgb, opacity = field.trace(rays, termination, seen.span, skip_empty, surface)
        found = [] if surface is None else [surface.distance[:, None]]
        image.index_copy_(0, seen.pixel, torch.cat([rgb, opacity[:, None], *found], -1))
    return image.view(shape)
