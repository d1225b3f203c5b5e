"""The paper's estimator, in reverse mode: Tools 1 to 3 (Sec. 3.1, Eq. 9 and its patch-wise form).

First forward: images without derivatives (the caller's). Then v and the images' cotangents. Second forward:
rays of one patch at a time, replayed from the same draw, each backward at once into the draw's few numbers
per image. The chain from psi to the draw is walked once, at the end. Where the first render carried tangents
(``tangents.py``), they are contracted instead, and there is no second forward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim import cameras
from neural_sim.gradient.base import (
    CONTINUOUS,
    ImageLoss,
    Maps,
    MixedDerivative,
    ObjectImages,
    Params,
    RenderedPath,
    from_contributions,
)
from neural_sim.gradient.mixed import Mode, image_cotangent
from neural_sim.types import PinholeCamera, Rays, SceneDraw

RenderRays = Callable[[Rays], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Pathwise:
    """Settings of the reverse pathwise estimator: rays in a patch, images in a chunk, mode of the theta derivative."""

    patch_size: int = 4096
    chunk_size: int = 16
    mode: Mode = "forward"

    def __post_init__(self) -> None:
        if self.patch_size < 1 or self.chunk_size < 1:
            raise ValueError(
                f"pathwise: patch_size and chunk_size must be positive, got {self.patch_size}, {self.chunk_size}"
            )

    def estimate(
        self, loss_of: ImageLoss, params: Params, vector: Params, object_images: ObjectImages
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` through the images. Raises ``ValueError`` if they carry no path."""
        path, here = object_images.path, object_images
        if path is None:
            raise ValueError(
                "pathwise: these images carry no rendered path, which this estimator differentiates"
            )
        cotangent = image_cotangent(
            loss_of, params, vector, here.images, here.index, here.weights, self.chunk_size, self.mode
        )
        maps = map_cotangents(path, cotangent)
        if path.tangents is not None:
            along_draw = contract(path.tangents, maps)
        else:
            along_draw = draw_cotangents(path.render_rays, path.camera, here.draw, maps, self.patch_size)
        return from_contributions(psi_contributions(path.relaxed, here.psi, along_draw))


def map_cotangents(path: RenderedPath, image_cotangents: Float[Tensor, "n 3 h w"]) -> Maps:
    """Image cotangents pulled back through the compositing onto the rendered maps."""
    rgb, opacity = path.rgb.detach().requires_grad_(), path.opacity.detach().requires_grad_()
    with torch.enable_grad():
        images = path.compose(rgb, opacity)
    pulled = torch.autograd.grad(images, (rgb, opacity), image_cotangents, materialize_grads=True)
    return Maps(*pulled)


def patch_rays(
    camera: PinholeCamera, camera_to_world: Float[Tensor, "n 4 4"], pixels: Int[Tensor, "r"]
) -> Rays:
    """Rays of the pixels with the given flat indices into [n, height, width]; differentiable in the poses."""
    local = cameras.pixel_directions(camera, dtype=camera_to_world.dtype, device=camera_to_world.device)
    per_image = camera.height * camera.width
    poses = camera_to_world[pixels // per_image]
    directions = torch.einsum("rij,rj->ri", poses[:, :3, :3], local.reshape(-1, 3)[pixels % per_image])
    return Rays(poses[:, :3, 3], directions)


def draw_cotangents(
    render_rays: RenderRays, camera: PinholeCamera, draw: SceneDraw, maps: Maps, patch_size: int
) -> dict[str, Float[Tensor, "n"]]:
    """Cotangents of the draw's numbers, phi, rho and distance: the second forward and the only backward
    (Tools 2, 3).

    Memory is that of ``patch_size`` rays. Pixels whose cotangent is exactly zero are left out, which changes
    nothing.
    """
    rgb, opacity = maps.rgb.reshape(-1, 3), maps.opacity.reshape(-1)
    live = ((rgb != 0.0).any(-1) | (opacity != 0.0)).nonzero().squeeze(-1)
    total = {name: torch.zeros_like(getattr(draw, name)) for name in CONTINUOUS}
    for pixels in live.split(patch_size) if len(live) else ():
        leaves = {name: getattr(draw, name).detach().requires_grad_() for name in CONTINUOUS}
        with torch.enable_grad():
            rendered = render_rays(patch_rays(camera, cameras.orbit(**leaves), pixels))
        parts = torch.autograd.grad(
            rendered, list(leaves.values()), (rgb[pixels], opacity[pixels]), materialize_grads=True
        )
        for name, part in zip(CONTINUOUS, parts, strict=True):
            total[name] += part
    return total


def contract(tangents: Mapping[str, Maps], maps: Maps) -> dict[str, Float[Tensor, "n"]]:
    """Cotangents of the draw's numbers: each image's tangents against the maps' cotangents, image by image."""
    return {
        name: (tangent.rgb * maps.rgb).sum((1, 2, 3)) + (tangent.opacity * maps.opacity).sum((1, 2))
        for name, tangent in tangents.items()
    }


def psi_contributions(
    relaxed: Callable[[Float[Tensor, "k"]], SceneDraw],
    psi: Float[Tensor, "k"],
    cotangents: Mapping[str, Float[Tensor, "n"]],
) -> Float[Tensor, "n k"]:
    """Every image's part in the derivative by psi: its draw's cotangents through the replayed relaxed draw
    (Tool 1).

    Rows sum to the vector-Jacobian product; they are kept apart for the standard error.
    """
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        draw = relaxed(leaf)
        along = sum(getattr(draw, name) * cotangent for name, cotangent in cotangents.items())
    rows = torch.zeros(len(draw), psi.numel(), dtype=psi.dtype, device=psi.device)
    if not (isinstance(along, Tensor) and along.requires_grad):
        return rows  # nothing in this draw depends on psi
    for image in range(len(draw)):
        (rows[image],) = torch.autograd.grad(along[image], leaf, retain_graph=True, materialize_grads=True)
    return rows
