"""The pathwise derivative in forward mode: dx/dV rides along with the first render.

V has a few numbers per image and an image has thousands, so a tangent per number of V costs one image each;
no second render, no patches in the backward pass. Only the numbers that psi moves need a tangent (for a
binned phi, one).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.gradient.base import CONTINUOUS, Maps
from neural_sim.gradient.pathwise import RenderRays, patch_rays
from neural_sim.types import PinholeCamera, SceneDraw


def moved_by(relaxed: Callable[[Float[Tensor, "k"]], SceneDraw], psi: Float[Tensor, "k"]) -> tuple[str, ...]:
    """Names of the draw's numbers that depend on psi; the others need no tangent."""
    with torch.enable_grad():
        draw = relaxed(psi.detach().requires_grad_())
    return tuple(name for name in CONTINUOUS if getattr(draw, name).requires_grad)


def render_with_tangents(
    render_rays: RenderRays,
    camera: PinholeCamera,
    draw: SceneDraw,
    names: tuple[str, ...] = CONTINUOUS,
    patch_size: int = 4096,
) -> tuple[Maps, dict[str, Maps]]:
    """The rendered maps, and their derivative by each of the draw's ``names``, every image by its own number.

    One Jacobian-vector product per name and patch of ``patch_size`` rays, so that working memory beyond the
    outputs does not grow with the images. Raises ``ValueError`` for a name that is not a continuous number of
    the draw.
    """
    if unknown := set(names) - set(CONTINUOUS):
        raise ValueError(f"tangents: got {sorted(unknown)}, want names among {CONTINUOUS}")
    numbers = {name: getattr(draw, name).detach() for name in CONTINUOUS}
    still = {name: torch.zeros_like(number) for name, number in numbers.items()}
    total = len(draw) * camera.height * camera.width
    device = draw.phi.device
    values, moved = [], {name: [] for name in names}
    for pixels in torch.arange(total, device=device).split(patch_size):

        def patch(numbers: Mapping[str, Tensor], pixels: Tensor = pixels) -> tuple[Tensor, Tensor]:
            return render_rays(patch_rays(camera, cameras.orbit(**numbers), pixels))

        if not names:
            values.append(patch(numbers))
        for position, name in enumerate(names):
            direction = {**still, name: torch.ones_like(numbers[name])}
            value, tangent = torch.func.jvp(patch, (numbers,), (direction,))[:2]
            moved[name].append(tangent)
            if position == 0:
                values.append(value)
    shape = (len(draw), camera.height, camera.width)
    return _join(values, shape), {name: _join(parts, shape) for name, parts in moved.items()}


def _join(parts: list[tuple[Tensor, Tensor]], shape: tuple[int, int, int]) -> Maps:
    rgb, opacity = (torch.cat(pieces).detach() for pieces in zip(*parts, strict=True))
    return Maps(rgb.view(*shape, 3), opacity.view(shape))
