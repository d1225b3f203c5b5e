"""The training rays of a set of views: those near the object's silhouettes, shuffled."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neural_sim.alpha import premultiplied
from neural_sim.cameras import pixel_rays
from neural_sim.types import PosedViews, Rays


@dataclass(frozen=True)
class RayPool:
    """Rays (rays, 3), their premultiplied RGBA pixels and views, and the phase in [0, 1) of each ray's sample lattice.

    With different phases, neighbouring rays sample different depths, so that no depth is missed.
    """

    rays: Rays
    pixels: Float[Tensor, "rays 4"]
    phase: Float[Tensor, "rays"]
    view: Int[Tensor, "rays"]

    def __len__(self) -> int:
        return self.pixels.shape[0]

    def select(self, index: Int[Tensor, "some"] | slice) -> RayPool:
        """Return some of the rays."""
        rays = Rays(self.rays.origins[index], self.rays.directions[index])
        return RayPool(rays, self.pixels[index], self.phase[index], self.view[index])


def build_pool(views: PosedViews, border: int | None, generator: torch.Generator) -> RayPool:
    """Collect the rays of all pixels within ``border`` pixels of a silhouette (None: all), in random order.

    Consecutive rays of the pool are therefore a random batch.

    Raises:
        ValueError: every alpha is zero.
    """
    alpha = views.images[..., 3]
    near = (alpha > 0.0).to(alpha.dtype)[:, None]
    if border is None:
        near = torch.ones_like(near)
    elif border > 0:
        near = functional.max_pool2d(near, (2 * border + 1, 1), 1, (border, 0))
        near = functional.max_pool2d(near, (1, 2 * border + 1), 1, (0, border))
    if views.known is not None:
        near = near * views.known[:, None]
    index = near.flatten().nonzero()[:, 0]
    if not len(index):
        raise ValueError(f"build_pool: the alpha of all {len(views)} views is zero, want silhouettes")
    order = torch.randperm(len(index), generator=generator, device=generator.device)
    index = index[order.to(index.device)]
    phase = torch.rand(len(index), generator=generator, device=generator.device).to(alpha)
    pixels = views.images.reshape(-1, 4).index_select(0, index)
    rays = pixel_rays(views.camera, views.camera_to_world.to(alpha), index)
    view = index // (views.camera.height * views.camera.width)
    return RayPool(Rays(rays.origins.contiguous(), rays.directions), premultiplied(pixels), phase, view)
