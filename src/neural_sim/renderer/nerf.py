"""Images of a radiance field, and their derivative with respect to the rays."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.field.rendering import render_packed, render_views, render_with_tangents
from neural_sim.types import Maps, PinholeCamera, Rays


class NerfRenderer:
    """Renders whole views at once, or any bundle of rays with derivatives.

    ``termination`` is the transmittance behind which samples are left out (0: none are), ``rays_per_chunk`` bounds
    the working memory of ``render``. Which samples are taken depends on the rays alone, so a replay is identical.
    """

    def __init__(self, termination: float = 1e-3, rays_per_chunk: int = 32768) -> None:
        if not 0.0 <= termination < 1.0:
            raise ValueError(f"NerfRenderer: termination must lie in [0, 1), got {termination}")
        if rays_per_chunk < 1:
            raise ValueError(f"NerfRenderer: rays_per_chunk must be at least 1, got {rays_per_chunk}")
        self.termination = termination
        self.rays_per_chunk = rays_per_chunk

    @torch.no_grad()
    def render(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        exact: bool = False,
    ) -> tuple[Float[Tensor, "views height width 3"], Float[Tensor, "views height width"]]:
        """Premultiplied colour and opacity; ``exact`` leaves no sample out behind opaque surfaces."""
        termination = 0.0 if exact else self.termination
        image = render_views(
            field, camera, camera_to_world, termination, self.rays_per_chunk, not exact, not exact
        )
        return image[..., :3], image[..., 3]

    @torch.no_grad()
    def render_with_tangents(
        self,
        field: RadianceField,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "views 4 4"],
        rates: Float[Tensor, "m views 4 4"],
    ) -> tuple[Maps, list[Maps]]:
        """What ``render`` gives, and its m >= 1 derivatives where the cameras move at ``rates``.

        The derivatives ride along with the render; memory beyond the maps is that of ``rays_per_chunk`` rays.
        """
        views_per_chunk = max(1, self.rays_per_chunk // (camera.width * camera.height))
        values, moved = [], []
        for poses, pose_rates in zip(
            camera_to_world.split(views_per_chunk), rates.split(views_per_chunk, 1), strict=True
        ):
            # Rays are linear in the pose, so that the rays of a pose's rate are the rays' rates.
            bundle, bundle_rates = (_flat(cameras.rays(camera, pose)) for pose in (poses, pose_rates))
            parts = [
                render_with_tangents(field, rays, ray_rates, self.termination)
                for rays, ray_rates in zip(
                    _split(bundle, self.rays_per_chunk),
                    _split(bundle_rates, self.rays_per_chunk),
                    strict=True,
                )
            ]
            values += [value for value, _ in parts]
            moved += [rate for _, rate in parts]
        shape = (len(camera_to_world), camera.height, camera.width, 4)
        value, tangents = torch.cat(values).view(shape), torch.cat(moved, 1).view(-1, *shape)
        return _maps(value), [_maps(tangent) for tangent in tangents]

    def render_rays(
        self, field: RadianceField, rays: Rays
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:
        """Premultiplied colour and opacity of rays (rays, 3), zero where a ray misses.

        Differentiable in origins and directions, in reverse and forward mode; the sample distances are constants,
        chosen without noise. Raises ValueError for another shape of rays.
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
        return render_packed(field, rays, self.termination)


def _flat(bundle: Rays) -> Rays:
    """Views, rows and columns of rays as one axis."""
    return Rays(bundle.origins.flatten(-4, -2), bundle.directions.flatten(-4, -2))


def _split(bundle: Rays, size: int) -> list[Rays]:
    pairs = zip(bundle.origins.split(size, -2), bundle.directions.split(size, -2), strict=True)
    return [Rays(origins, directions) for origins, directions in pairs]


def _maps(pixels: Float[Tensor, "n h w 4"]) -> Maps:
    return Maps(pixels[..., :3], pixels[..., 3])
