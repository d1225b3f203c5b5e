"""How well a field shows views that it was not fitted to."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from neural_sim.alpha import over_white, premultiplied
from neural_sim.field.base import RadianceField
from neural_sim.field.rendering import render_views
from neural_sim.types import PosedViews


def score_views(
    field: RadianceField, views: PosedViews, termination: float, rays_per_chunk: int
) -> dict[str, float]:
    """``compare`` of the field's images with these views."""
    rendered = render_views(field, views.camera, views.camera_to_world, termination, rays_per_chunk)
    return compare(where_known(rendered, views), views.images)


def where_known(
    rendered: Float[Tensor, "views height width 4"], views: PosedViews
) -> Float[Tensor, "views height width 4"]:
    """Renders without the pixels that these views do not show."""
    return rendered if views.known is None else rendered * views.known[..., None]


def compare(
    rendered: Float[Tensor, "views height width 4"], images: Float[Tensor, "views height width 4"]
) -> dict[str, float]:
    """``psnr`` and ``ssim`` of premultiplied renders and views over white, ``psnr_foreground`` over the pixels of alpha
    above 0.

    PSNR in dB, mean over views of each view's value; SSIM as torchmetrics' default (Gaussian window, range 1).
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
