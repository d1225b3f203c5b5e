"""Views of a field, each under its own code, and codes fitted to views of unknown light."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.alpha import premultiplied
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.objective import expected_error
from neural_sim.field.quadrature import render_weights, sum_rays
from neural_sim.field.rendering import render_views, sample_points
from neural_sim.types import PosedViews, Rays


@torch.no_grad()
def render_lit(
    field: AppearanceField,
    codes: Float[Tensor, "views code"],
    views: PosedViews,
    termination: float,
    rays_per_chunk: int,
) -> Float[Tensor, "views height width 4"]:
    """Premultiplied RGBA from the views' cameras, each under its own code."""
    poses = views.camera_to_world
    rendered = [
        render_views(field.lit(code), views.camera, poses[i : i + 1], termination, rays_per_chunk)
        for i, code in enumerate(codes)
    ]
    return torch.cat(rendered)


def right_half(images: Float[Tensor, "views height width c"]) -> Float[Tensor, "views height half c"]:
    return images[:, :, images.shape[2] // 2 :]


def fit_codes(
    field: AppearanceField,
    views: PosedViews,
    termination: float,
    steps: int = 100,
    learning_rate: float = 0.1,
) -> Float[Tensor, "views code"]:
    """Codes that show the left halves of these views best; the field stays as it is.

    Geometry and features do not depend on codes: they are looked up once, and each of ``steps`` steps of Adam
    evaluates the colour head alone.
    """
    half = views.camera.width // 2
    bundle = cameras.rays(views.camera, views.camera_to_world)
    rays = Rays(*(part[:, :, :half].reshape(-1, 3) for part in (bundle.origins, bundle.directions)))
    pixels = premultiplied(views.images[:, :, :half].reshape(-1, 4))
    with torch.no_grad():
        samples = field.sample(rays, termination)
        positions, directions = sample_points(rays, samples)
        raw = field.grid.raw(positions)
        weights = render_weights(field.grid.density(raw), samples)[:, None]
        if views.known is not None:
            weights = weights * views.known[:, :, :half].reshape(-1).index_select(0, samples.ray)[:, None]
        opacity = sum_rays(weights, samples)[:, 0]
    view = samples.ray // (len(pixels) // len(views))
    codes = field.anchors.detach().mean(0).repeat(len(views), 1).requires_grad_()
    optimizer = torch.optim.Adam([codes], lr=learning_rate)
    for _ in range(steps):
        with torch.enable_grad():
            _, rgb = field.decode(raw, directions, field.gain(codes).index_select(0, view))
            loss = expected_error((sum_rays(weights * rgb, samples), opacity), pixels)
            (codes.grad,) = torch.autograd.grad(loss, [codes])
        optimizer.step()
    return codes.detach()
