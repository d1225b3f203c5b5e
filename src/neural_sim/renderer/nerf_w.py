"""Images of a field with appearance codes, and their derivatives by camera and light."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.quadrature import composite, composite_with_tangents, render_weights, sum_rays
from neural_sim.field.rendering import render_views, sample_points
from neural_sim.renderer.nerf import NerfRenderer, check_rays, flat_rays, split_maps, split_rays
from neural_sim.types import Maps, PinholeCamera, Rays


class NerfWRenderer(NerfRenderer):
    """``NerfRenderer`` whose views have weights over the field's anchors, normally adding up to 1.

    A view's code is ``weights @ field.anchors`` (paper, Sec. 3.3). Views of equal weights are rendered as one batch
    under one code. Opacity depends on no weight. Without weights the anchors count equally.
    """

    @torch.no_grad()
    def render(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        exact: bool = False,
        weights: Float[Tensor, "views k"] | None = None,
    ) -> tuple[Float[Tensor, "views height width 3"], Float[Tensor, "views height width"]]:
        """Premultiplied colour and opacity; ``exact`` leaves no sample out behind opaque surfaces."""
        field, weights = _checked(field, weights, len(camera_to_world))
        termination = 0.0 if exact else self.termination
        shape = (len(camera_to_world), camera.height, camera.width, 4)
        image = camera_to_world.new_empty(shape)
        for light, views in _groups(weights):
            lit = field.lit(light @ field.anchors)
            poses = camera_to_world.index_select(0, views)
            image[views] = render_views(lit, camera, poses, termination, self.rays_per_chunk)
        return image[..., :3], image[..., 3]

    @torch.no_grad()
    def render_with_tangents(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        rates: Float[Tensor, "m views 4 4"],
        weights: Float[Tensor, "views k"] | None = None,
        weight_rates: Float[Tensor, "q views k"] | None = None,
    ) -> tuple[Maps, list[Maps]]:
        """What ``render`` gives, its m derivatives where cameras move at ``rates``, then q where weights do.

        m or q may be 0, not both. Opacity's derivatives by weights are exactly 0.
        """
        views = len(camera_to_world)
        field, weights = _checked(field, weights, views)
        if weight_rates is None:
            weight_rates = weights.new_zeros(0, *weights.shape)
        turned = torch.cat([weights[None], weight_rates]).movedim(0, 1).flatten(1)
        shape = (1 + len(rates) + len(weight_rates), views, camera.height, camera.width, 4)
        maps = camera_to_world.new_empty(shape)
        for row, here in _groups(turned):
            light, *light_rates = row.view(-1, weights.shape[1])
            gain = field.gain(light @ field.anchors)
            moved = torch.stack(light_rates) if light_rates else weights.new_zeros(0, weights.shape[1])
            gain_rates = (moved @ field.anchors) @ field.code.weight.t()
            bundle = flat_rays(cameras.rays(camera, camera_to_world.index_select(0, here)))
            bundle_rates = flat_rays(cameras.rays(camera, rates.index_select(1, here)))
            parts = [
                self._rays_with_tangents(field, rays, ray_rates, gain, gain_rates)
                for rays, ray_rates in zip(
                    split_rays(bundle, self.rays_per_chunk),
                    split_rays(bundle_rates, self.rays_per_chunk),
                    strict=True,
                )
            ]
            maps[:, here] = torch.cat(parts, 1).view(-1, len(here), *shape[2:])
        value, *tangents = map(split_maps, maps)
        return value, tangents

    def _rays_with_tangents(
        self, field: AppearanceField, rays: Rays, rates: Rays, gain: Tensor, gain_rates: Tensor
    ) -> Float[Tensor, "maps rays 4"]:
        samples = field.sample(rays, self.termination)
        positions, directions = sample_points(rays, samples)
        turns = rates.directions.index_select(1, samples.ray)
        velocities = torch.addcmul(
            rates.origins.index_select(1, samples.ray), turns, samples.distance[:, None]
        )
        sigma, rgb, sigma_rates, rgb_rates, lit_rates = field.query_with_tangents_of_code(
            positions, directions, velocities, turns, gain, gain_rates
        )
        value, moved = composite_with_tangents(sigma, rgb, sigma_rates, rgb_rates, samples)
        shown = render_weights(sigma, samples)[:, None] * lit_rates.flatten(1)
        lit = sum_rays(shown, samples).unflatten(1, (-1, 3)).movedim(1, 0)
        return torch.cat([value[None], moved, torch.nn.functional.pad(lit, (0, 1))])

    def render_rays(
        self, field: RadianceField, rays: Rays, weights: Tensor | None = None
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Premultiplied colour and opacity of rays (rays, 3), zero where a ray misses.

        ``weights`` are those of all rays (k) or one row a ray (rays, k). Differentiable in origins, directions and
        weights, in reverse and forward mode.
        """
        check_rays(rays)
        per_ray = weights is not None and weights.ndim == 2
        field, rows = _checked(
            field, weights if per_ray else _row(weights), len(rays.origins) if per_ray else 1
        )
        samples = field.sample(rays, self.termination)
        positions, directions = sample_points(rays, samples)
        gain = field.gain(rows @ field.anchors)
        gain = gain.index_select(0, samples.ray) if per_ray else gain[0]
        return composite(*field.decode(field.grid.raw(positions), directions, gain), samples)


def _row(weights: Float[Tensor, "k"] | None) -> Float[Tensor, "1 k"] | None:
    return None if weights is None else weights[None]


def _checked(
    field: RadianceField, weights: Float[Tensor, "n k"] | None, count: int
) -> tuple[AppearanceField, Float[Tensor, "n k"]]:
    """The field with codes that this renderer wants, and weights for ``count`` views or rays, in its type."""
    if not isinstance(field, AppearanceField):
        raise ValueError(
            f"renderer=nerf_w wants fields with appearance codes (field=grid_w), got {type(field).__name__}"
        )
    anchors = len(field.mixing)
    if weights is None:
        return field, field.codes.new_full((count, anchors), 1.0 / anchors)
    if weights.shape != (count, anchors):
        raise ValueError(f"nerf_w: want weights of shape ({count}, {anchors}), got {tuple(weights.shape)}")
    return field, weights.to(field.codes)


def _groups(rows: Float[Tensor, "views c"]) -> Iterator[tuple[Float[Tensor, "c"], Int[Tensor, "some"]]]:
    """The different rows, and which views have each."""
    different, number = rows.unique(dim=0, return_inverse=True)
    for place, row in enumerate(different):
        yield row, (number == place).nonzero()[:, 0]
