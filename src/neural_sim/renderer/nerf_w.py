"""Render images of a field with appearance codes, and their derivatives with respect to camera and light."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.quadrature import composite, sample_points
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import Maps, PinholeCamera, Rays


class NerfWRenderer(NerfRenderer):
    """A ``NerfRenderer`` whose views have weights over the field's anchors, normally adding up to 1.

    A view's code is ``weights @ field.anchors`` (paper, Sec. 3.2). Views with equal weights are rendered as one batch
    under one code. Opacity does not depend on the weights. Without weights, all anchors have the same weight.
    """

    @override
    @staticmethod
    def check(kind: type[RadianceField]) -> None:
        if not issubclass(kind, AppearanceField):
            raise ValueError(
                f"renderer=nerf_w needs a field with appearance codes: want field=grid_w, got {kind.__name__}"
            )

    @torch.no_grad()
    def render(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        exact: bool = False,
        weights: Float[Tensor, "views k"] | None = None,
    ) -> tuple[Float[Tensor, "views height width 3"], Float[Tensor, "views height width"]]:
        """Render premultiplied colour and opacity; ``exact`` skips nothing and uses the field's own step."""
        field, weights = _checked(field, weights, len(camera_to_world))
        shape = (len(camera_to_world), camera.height, camera.width)
        rgb, opacity = camera_to_world.new_empty(*shape, 3), camera_to_world.new_empty(shape)
        for light, views in _groups(weights, rgb.device):
            lit = field.lit(light @ field.anchors)
            rgb[views], opacity[views] = super().render(
                lit, camera, camera_to_world.index_select(0, views), exact
            )
        return rgb, opacity

    @torch.no_grad()
    def render_surface(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        weights: Float[Tensor, "views k"] | None = None,
    ) -> tuple[
        Float[Tensor, "views height width 3"],
        Float[Tensor, "views height width"],
        Float[Tensor, "views height width"],
    ]:
        """Render like ``render``, with the depth of ``NerfRenderer.render_surface``."""
        field, weights = _checked(field, weights, len(camera_to_world))
        maps = camera_to_world.new_empty(len(camera_to_world), camera.height, camera.width, 5)
        for light, views in _groups(weights, maps.device):
            lit = field.lit(light @ field.anchors)
            rgb, opacity, depth = super().render_surface(lit, camera, camera_to_world.index_select(0, views))
            maps[views] = torch.cat([rgb, opacity[..., None], depth[..., None]], -1)
        return maps[..., :3], maps[..., 3], maps[..., 4]

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
        """Render like ``render``, with m derivatives for moving cameras, then q for changing weights.

        Cameras move at ``rates`` and weights change at ``weight_rates``; m or q may be 0. Derivatives of opacity by
        weights are exactly 0.
        """
        field, weights = _checked(field, weights, len(camera_to_world))
        if weight_rates is None:
            weight_rates = weights.new_zeros(0, *weights.shape)
        shape = (len(camera_to_world), camera.height, camera.width, 4)
        maps = camera_to_world.new_empty(1 + len(rates) + len(weight_rates), *shape)
        together = torch.cat([weights[None], weight_rates.to(weights)]).movedim(0, 1)
        for row, views in _groups(together.flatten(1), maps.device):
            codes = row.view(-1, weights.shape[1]) @ field.anchors
            value, moved = super().render_with_tangents(
                field.lit(codes[0], codes[1:]),
                camera,
                camera_to_world.index_select(0, views),
                rates.index_select(1, views),
            )
            for number, map_ in enumerate([value, *moved]):
                maps[number, views] = torch.cat([map_.rgb, map_.opacity[..., None]], -1)
        value, *tangents = (Maps(image[..., :3], image[..., 3]) for image in maps)
        return value, tangents

    def render_rays(
        self, field: RadianceField, rays: Rays, weights: Tensor | None = None
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Render premultiplied colour and opacity of rays (rays, 3); zero where a ray misses.

        ``weights`` are shared by all rays (k) or have one row for each ray (rays, k). Differentiable in origins,
        directions and weights, in reverse and forward mode.
        """
        if weights is None or weights.ndim == 1:
            field, row = _checked(field, None if weights is None else weights[None], 1)
            return super().render_rays(field.lit(row[0].to(rays.origins.device) @ field.anchors), rays)
        field, weights = _checked(field, weights, len(rays.origins))
        field = field.with_step(self.step)
        samples = field.sample(rays, self.termination)
        positions, directions = sample_points(rays, samples)
        gain = field.gain(weights.to(positions) @ field.anchors).index_select(0, samples.ray)
        return composite(*field.decode(field.grid.raw(positions), directions, gain), samples)


def _checked(
    field: RadianceField, weights: Float[Tensor, "n k"] | None, count: int
) -> tuple[AppearanceField, Float[Tensor, "n k"]]:
    """Return the field, which must have appearance codes, and weights [count, k] in its dtype.

    The weights stay on their own device: draws are on the CPU.
    """
    NerfWRenderer.check(type(field))
    assert isinstance(field, AppearanceField)
    anchors = len(field.mixing)
    if weights is None:
        return field, torch.full((count, anchors), 1.0 / anchors, dtype=field.codes.dtype)
    if weights.shape != (count, anchors):
        raise ValueError(f"nerf_w: want weights of shape ({count}, {anchors}), got {tuple(weights.shape)}")
    return field, weights.to(field.codes.dtype)


def _groups(
    rows: Float[Tensor, "views c"], device: torch.device
) -> Iterator[tuple[Float[Tensor, "c"], Int[Tensor, "some"]]]:
    """Yield each distinct row and its views, on ``device``; rows are compared on the CPU."""
    different, number = rows.cpu().unique(dim=0, return_inverse=True)
    for place, row in enumerate(different.to(device)):
        yield row, (number == place).nonzero()[:, 0].to(device)
