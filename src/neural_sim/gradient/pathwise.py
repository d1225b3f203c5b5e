"""The paper's estimator: relaxed draws, differentiated through the renderer (Sec. 3.1, Tools 1 to 3, Eqs. 3 to 6).

Reverse mode is the paper's. The first forward pass renders images without derivatives; then v and the images'
cotangents are computed. The second forward pass renders the rays of the same draw patch by patch; after each patch, a
backward pass adds to the derivatives with respect to V, a few numbers for each image. Forward mode needs neither a
second render nor patches: because V has only a few numbers, the first render also computes the images' derivatives with
respect to each, and the cotangents are contracted with them. In both modes the draw is differentiated once, at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.devices import moved
from neural_sim.gradient.base import (
    Losses,
    MixedDerivative,
    ObjectImages,
    Params,
    Probes,
    RenderedPath,
    from_contributions,
)
from neural_sim.gradient.mixed import image_cotangents
from neural_sim.gradient.reversal import Wanted
from neural_sim.gradient.significance import zero_mean
from neural_sim.gradient.unrolled import Accumulated
from neural_sim.parameter.bins import is_closed
from neural_sim.parameter.factor import COORDINATES
from neural_sim.parameter.product import RelaxedDraws
from neural_sim.ranges import PositiveInt, validated
from neural_sim.synthesis.motion import RIGID, moved_by, number_of
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

Mode = Literal["forward", "reverse"]
RenderRays = Callable[[Rays], tuple[Tensor, Tensor]]


@validated
@dataclass(frozen=True)
class PathwiseEstimator:
    """Relaxed draws, differentiated through the renderer.

    Args:
        mode: how images are differentiated by V. ``forward``: during the first render; ``reverse``: by the paper's
            second forward pass, patch by patch.
        patch_size: number of rays in a patch of the reverse mode.
        chunk_size: number of images whose losses are differentiated at a time.

    Raises:
        ValueError: any of these is out of its range; the message has the key and the value.
    """

    wanted: ClassVar[Wanted] = "inputs"
    mode: Mode = "forward"
    patch_size: PositiveInt = 4096
    chunk_size: PositiveInt = 16

    @property
    def probes_per_bin(self) -> int:
        """0: the iteration's own images are differentiated."""
        return 0

    @property
    def draws(self) -> RelaxedDraws:
        """How this estimator's images are drawn."""
        return RelaxedDraws(tangents=self.mode == "forward")

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """See ``Estimator``.

        p-values come from ``significance.zero_mean`` of the images' contributions.

        Raises:
            ValueError: the images have no path.
        """
        path = _path(images)
        cotangents = image_cotangents(
            losses.from_images,
            params,
            vector,
            _pixels(images),
            images.index,
            images.weights,
            self.chunk_size,
        )
        return self._through_images(path, cotangents, images)

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        """See ``Estimator``."""
        path = _path(images)
        cotangents = sums.cotangents(_pixels(images), images.index, self.chunk_size)
        return self._through_images(path, cotangents, images)

    def _through_images(
        self, path: RenderedPath, cotangents: Float[Tensor, "n 3 h w"], images: ObjectImages
    ) -> MixedDerivative:
        maps = map_cotangents(path, cotangents)
        along_draw = contract(path.tangents or {}, maps)
        if set(moved_by(path.relaxed, images.psi)) - set(along_draw):
            # The first render always computes derivatives with respect to the lights, but only in forward mode those by
            # coordinates.
            along_draw |= draw_cotangents(path.render_rays, path.camera, images.draw, maps, self.patch_size)
        # From here on there are only a few numbers per image; they are on the CPU, like psi and the draws.
        along_draw = dict(zip(along_draw, moved(list(along_draw.values()), images.psi.device), strict=True))
        contributions = psi_contributions(path.relaxed, images.psi, along_draw)
        psi, p_values = images.distribution.split(images.psi), {}
        for name, part in images.distribution.split(contributions).items():
            # Closed bins would add rounding errors, which the test scales up to the size of the other components.
            counted = part[:, ~is_closed(psi[name])]
            # An offset common to all components changes neither probabilities nor weights of lights.
            p_values[name] = zero_mean(counted - counted.mean(-1, keepdim=True))
        return replace(from_contributions(contributions), p_values=p_values)


def _path(images: ObjectImages) -> RenderedPath:
    if images.path is None:
        raise ValueError("pathwise: these images have no rendered path to differentiate")
    return images.path


def _pixels(images: ObjectImages) -> Float[Tensor, "n 3 h w"]:
    assert images.images is not None  # images with a path always have pixels
    return images.images


def map_cotangents(path: RenderedPath, cotangents: Float[Tensor, "n 3 h w"]) -> Maps:
    """Pull cotangents of images back through the compositing onto the maps."""
    rgb, opacity = path.rgb.detach().requires_grad_(), path.opacity.detach().requires_grad_()
    with torch.enable_grad():
        composed = path.compose(rgb, opacity)
    return Maps(*torch.autograd.grad(composed, (rgb, opacity), cotangents, materialize_grads=True))


def draw_cotangents(
    render_rays: RenderRays, camera: PinholeCamera, draw: SceneDraw, maps: Maps, patch_size: int
) -> dict[str, Float[Tensor, "n"]]:
    """Compute cotangents of the draw's coordinates: the second forward and the only backward pass (Tools 2, 3).

    Only ``patch_size`` rays are in memory at a time. Pixels whose cotangent is exactly zero contribute nothing and are
    skipped.
    """
    rgb, opacity = maps.rgb.reshape(-1, 3), maps.opacity.reshape(-1)
    live = ((rgb != 0.0).any(-1) | (opacity != 0.0)).nonzero().squeeze(-1)
    drawn = {name: getattr(draw, name) for name in COORDINATES if getattr(draw, name) is not None}
    on_device = moved([number.detach() for number in drawn.values()], rgb.device)
    numbers = dict(zip(drawn, on_device, strict=True))
    total = {name: torch.zeros_like(number) for name, number in numbers.items()}
    for pixels in torch.split(live, patch_size) if len(live) else ():
        leaves = {name: number.detach().requires_grad_() for name, number in numbers.items()}
        with torch.enable_grad():
            poses = cameras.orbit(*(leaves[name] for name in RIGID), radius=draw.radius)
            rendered = render_rays(cameras.pixel_rays(camera, poses, pixels, leaves.get("magnification")))
        parts = torch.autograd.grad(
            rendered, list(leaves.values()), (rgb[pixels], opacity[pixels]), materialize_grads=True
        )
        for name, part in zip(leaves, parts, strict=True):
            total[name] += part
    return total


def contract(tangents: Mapping[str, Maps], maps: Maps) -> dict[str, Float[Tensor, "n"]]:
    """Contract each image's tangents with its maps' cotangents, to give the cotangents of the draw's numbers."""
    return {
        name: (tangent.rgb * maps.rgb).sum((1, 2, 3)) + (tangent.opacity * maps.opacity).sum((1, 2))
        for name, tangent in tangents.items()
    }


def psi_contributions(
    relaxed: Callable[[Float[Tensor, "K"]], SceneDraw],
    psi: Float[Tensor, "K"],
    cotangents: Mapping[str, Float[Tensor, "n"]],
) -> Float[Tensor, "n K"]:
    """Compute each image's part of the derivative with respect to psi: pull cotangents back through Tool 1's draw.

    Rows sum to the vector-Jacobian product; the standard error needs them separately. psi has fewer numbers than there
    are images, so forward mode, with one pass for each number of psi, is the cheaper way to compute all rows.
    """

    def along(psi: Tensor) -> Tensor:
        draw = relaxed(psi)
        return torch.stack([number_of(draw, name) * value for name, value in cotangents.items()]).sum(0)

    basis = torch.eye(psi.numel(), dtype=psi.dtype, device=psi.device)
    return torch.stack([torch.func.jvp(along, (psi.detach(),), (e,))[1] for e in basis], -1)
