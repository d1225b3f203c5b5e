"""Render images of a radiance field, and their derivatives with respect to the camera or the rays."""

from __future__ import annotations

from typing import Annotated

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import focal_lengths, pixel_rays, principal_point, ray_rates
from neural_sim.devices import at_once
from neural_sim.field.base import RadianceField
from neural_sim.field.pixels import seen_pixels
from neural_sim.field.rendering import SAMPLES_AT_ONCE, render_packed, render_views, render_with_tangents
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import Maps, PinholeCamera, Rays


@validated
class NerfRenderer:
    """Renders whole views at once, or any bundle of rays with derivatives.

    Samples depend on the field and the rays alone, so a replay is identical, and values and derivatives belong to the
    same function. Against complete renders of six YCB objects (128 pixels), the defaults have a mean error of opacity
    of 3.0e-4 over the pixels that show the object, and a PSNR of 82 dB.

    Args:
        rays_per_chunk: number of rays rendered at once, which bounds the working memory.
        termination: transmittance below which the rest of a ray is skipped (0: nothing is).
        step: factor on the field's step.
    """

    def __init__(
        self,
        rays_per_chunk: PositiveInt = 65536,
        termination: Annotated[float, Ge(0), Lt(1)] = 1e-3,
        step: Positive = 1.0,
    ) -> None:
        self.rays_per_chunk = rays_per_chunk
        self.termination, self.step = termination, step

    @staticmethod
    def check(kind: type[RadianceField]) -> None:
        """Raise ``ValueError`` for a kind of field that this renderer cannot draw."""

    @torch.no_grad()
    def render(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        exact: bool = False,
    ) -> tuple[Float[Tensor, "views height width 3"], Float[Tensor, "views height width"]]:
        """Render premultiplied colour and opacity; ``exact`` skips nothing and uses the field's own step."""
        if exact:
            image = render_views(field, camera, camera_to_world, 0.0, self.rays_per_chunk, False, False)
        else:
            image = render_views(
                field.with_step(self.step), camera, camera_to_world, self.termination, self.rays_per_chunk
            )
        return image[..., :3], image[..., 3]

    @torch.no_grad()
    def render_surface(
        self, field: RadianceField, camera: PinholeCamera, camera_to_world: Float[Tensor, "views 4 4"]
    ) -> tuple[
        Float[Tensor, "views height width 3"],
        Float[Tensor, "views height width"],
        Float[Tensor, "views height width"],
    ]:
        """Render like ``render``, with the depth along the view axis in object radii.

        The depth is where a pixel's ray has lost half of its light; it is 0 if the ray loses less (opacity below 1/2).
        """
        image = render_views(
            field.with_step(self.step), camera, camera_to_world, self.termination, self.rays_per_chunk,
            surfaces=True,
        )  # fmt: skip
        return image[..., :3], image[..., 3], image[..., 4] * _view_cosines(camera, image)

    @torch.no_grad()
    def render_with_tangents(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        rates: Float[Tensor, "m views 4 4"],
    ) -> tuple[Maps, list[Maps]]:
        """Render like ``render``, with m derivatives for cameras that move at ``rates``.

        If the field has a changing light, the derivatives with respect to it follow these m. Ray directions are kept at
        unit length whatever the rates, so that a rate may also be that of a focal length. One pass computes values and
        derivatives; beyond the maps, it takes the memory of ``rays_per_chunk`` rays.
        """
        field, shape = field.with_step(self.step), (len(camera_to_world), camera.height, camera.width, 4)
        value = camera_to_world.new_zeros(shape)
        tangents = camera_to_world.new_zeros(len(rates) + field.light_rates, *shape)
        for seen in seen_pixels(field, camera, camera_to_world, self.rays_per_chunk):
            rays = pixel_rays(camera, camera_to_world, seen.pixel)
            moving = ray_rates(camera, rays, rates, seen.pixel)
            samples_at_once = min(at_once(SAMPLES_AT_ONCE, value.device), 4 * self.rays_per_chunk)
            pixels, moved = render_with_tangents(field, rays, moving, self.termination, samples_at_once)
            value.view(-1, 4).index_copy_(0, seen.pixel, pixels)
            tangents.view(len(tangents), -1, 4).index_copy_(1, seen.pixel, moved)
        return _maps(value), [_maps(tangent) for tangent in tangents]

    def render_rays(
        self, field: RadianceField, rays: Rays
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Render premultiplied colour and opacity of rays (rays, 3); zero where a ray misses.

        Differentiable in origins and directions, in reverse and forward mode; the sample distances are constants,
        chosen without noise.

        Raises:
            ValueError: rays of another shape.
        """
        if (
            rays.origins.ndim != 2
            or rays.origins.shape != rays.directions.shape
            or rays.origins.shape[1] != 3
        ):
            raise ValueError(
                "NerfRenderer.render_rays: want origins and directions of shape (rays, 3), "
                f"got {tuple(rays.origins.shape)} and {tuple(rays.directions.shape)}"
            )
        return render_packed(field.with_step(self.step), rays, self.termination)


def _view_cosines(camera: PinholeCamera, like: Tensor) -> Float[Tensor, "height width"]:
    """Return the cosines of the angles between the pixels' rays and the view axis."""
    (fx, fy), (cx, cy) = focal_lengths(camera), principal_point(camera)
    x = (torch.arange(camera.width, dtype=like.dtype, device=like.device) + 0.5 - cx) / fx
    y = (torch.arange(camera.height, dtype=like.dtype, device=like.device) + 0.5 - cy) / fy
    return (1.0 + x.square() + y.square()[:, None]).rsqrt()


def _maps(pixels: Float[Tensor, "n h w 4"]) -> Maps:
    return Maps(pixels[..., :3], pixels[..., 3])
