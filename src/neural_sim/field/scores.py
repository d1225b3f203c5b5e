"""Scores of a field on views: the error that fitting minimises, and image metrics on held-out views."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from neural_sim import cameras
from neural_sim.alpha import over_white, premultiplied
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.quadrature import render_weights, sum_rays
from neural_sim.field.rendering import render_views, sample_points
from neural_sim.types import PosedViews, Rays

Rendering = tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]


def expected_error(rendering: Rendering, pixels: Float[Tensor, "rays 4"]) -> Float[Tensor, ""]:
    """Compute the mean squared colour error over a random background, uniform in [0, 1], in closed form.

    With d the error of premultiplied colour, a that of opacity and b the background, the pixel's error is d - a b;
    E b = 1/2 and E b^2 = 1/3. ``pixels`` are premultiplied RGBA.
    """
    colour = rendering[0] - pixels[:, :3]
    opacity = (rendering[1] - pixels[:, 3])[:, None]
    return (colour.square() - colour * opacity + opacity.square() / 3.0).mean()


def score_views(
    field: RadianceField, views: PosedViews, termination: float, rays_per_chunk: int
) -> dict[str, float]:
    """Render these views from the field, and ``compare`` the images with them."""
    rendered = render_views(field, views.camera, views.camera_to_world, termination, rays_per_chunk)
    return compare(where_known(rendered, views), views.images)


def where_known(
    rendered: Float[Tensor, "views height width 4"], views: PosedViews
) -> Float[Tensor, "views height width 4"]:
    """Return the renders, with 0 at pixels that the views do not show."""
    return rendered if views.known is None else rendered * views.known[..., None]


def compare(
    rendered: Float[Tensor, "views height width 4"], images: Float[Tensor, "views height width 4"]
) -> dict[str, float]:
    """Score premultiplied renders against views over white.

    The scores are ``psnr``, ``psnr_foreground`` (where a view's alpha is above 0) and ``ssim``. PSNR is in dB, averaged
    over views; SSIM is torchmetrics' default (Gaussian window, range 1).
    """
    shown, target = (
        over_white(image).movedim(-1, 1).clamp(0.0, 1.0) for image in (rendered, premultiplied(images))
    )
    psnr = peak_signal_noise_ratio(shown, target, data_range=1.0, dim=(1, 2, 3), reduction="elementwise_mean")
    ssim = structural_similarity_index_measure(shown, target, data_range=1.0)
    foreground = [
        peak_signal_noise_ratio(image[:, mask], truth[:, mask], data_range=1.0)
        for image, truth, mask in zip(shown, target, images[..., 3] > 0.0, strict=True)
        if bool(mask.any())
    ]
    return {
        "psnr": float(psnr),
        "psnr_foreground": float(torch.stack(foreground).mean()) if foreground else float("nan"),
        "ssim": float(ssim if isinstance(ssim, Tensor) else ssim[0]),
    }


@torch.no_grad()
def render_lit(
    field: AppearanceField,
    codes: Float[Tensor, "views code"],
    views: PosedViews,
    termination: float,
    rays_per_chunk: int,
) -> Float[Tensor, "views height width 4"]:
    """Render premultiplied RGBA from the views' cameras, each under its own code."""
    poses = views.camera_to_world
    rendered = [
        render_views(field.lit(code), views.camera, poses[i : i + 1], termination, rays_per_chunk)
        for i, code in enumerate(codes)
    ]
    return torch.cat(rendered)


def right_half(images: Float[Tensor, "views height width c"]) -> Float[Tensor, "views height half c"]:
    """Return the right half of every image."""
    return images[:, :, images.shape[2] // 2 :]


def fit_codes(
    field: AppearanceField,
    views: PosedViews,
    termination: float,
    steps: int = 100,
    learning_rate: float = 0.1,
) -> Float[Tensor, "views code"]:
    """Fit codes to the left halves of these views; the field does not change.

    Geometry and features do not depend on codes: they are looked up once, and each of ``steps`` steps of Adam
    evaluates only the colour head.
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
