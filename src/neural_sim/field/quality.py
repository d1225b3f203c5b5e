"""The quality of a field: scores on held-out views, and pictures for the user to judge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.recipe import RAYS_PER_CHUNK, TERMINATION
from neural_sim.field.rendering import render_views
from neural_sim.field.scores import fit_codes, render_lit, where_known
from neural_sim.types import PosedViews

POOR = 18.0
"""PSNR in dB on the object's pixels below which a field does not show the object: fields of real captures had 11 to
14 dB if they were debris, 20 and more if the object was recognisable."""


@dataclass(frozen=True)
class Placed:
    """The place of an object in its capture, in the capture's frame and unit.

    ``distances`` are those of the nearest and the farthest camera, in object radii.
    """

    centre: tuple[float, float, float]
    radius: float
    distances: tuple[float, float]


@dataclass(frozen=True)
class Quality:
    """The quality of an object's field, with pictures for the user to judge.

    Args:
        psnr: PSNR in dB on the object's pixels of the held-out views; None if there are no such views.
        ssim: SSIM on these pixels of the views that are shown.
        cells: number of a grid's occupied cells; None for other fields.
        views: held-out views over white, their masks and the field's renders of them, as bytes.
        photographs: whole photographs of these views, with everything but the object dimmed; empty for a mesh.
        bins: renders of the object from the middle of every bin, by factor.
        placed: the object's place, if it comes from photographs.
    """

    psnr: float | None
    ssim: float | None
    cells: int | None
    views: tuple[UInt8[Tensor, "n s s 3"], UInt8[Tensor, "n s s 1"], UInt8[Tensor, "n s s 3"]]
    photographs: tuple[UInt8[Tensor, "_ _ 3"], ...]
    bins: Mapping[str, UInt8[Tensor, "_ _ _ 3"]]
    placed: Placed | None


def as_views(field: RadianceField, views: PosedViews) -> Float[Tensor, "n h w 4"]:
    """Render premultiplied images from the views' cameras, under a code fitted to each view if the field has codes."""
    if not len(views):
        return views.images
    if isinstance(field, AppearanceField):
        codes = fit_codes(field, views, TERMINATION)
        return where_known(render_lit(field, codes, views, TERMINATION, RAYS_PER_CHUNK), views)
    rendered = render_views(field, views.camera, views.camera_to_world, TERMINATION, RAYS_PER_CHUNK)
    return where_known(rendered, views)


def similarity(
    rendered: Float[Tensor, "n h w 3"], truth: Float[Tensor, "n h w 3"], inside: Bool[Tensor, "n h w"]
) -> float | None:
    """Return the mean of the SSIM map over the object's pixels; None if no pixel shows it."""
    if not bool(inside.any()):
        return None
    every = structural_similarity_index_measure(
        rendered.movedim(-1, 1), truth.movedim(-1, 1), data_range=1.0, return_full_image=True
    )
    assert isinstance(every, tuple)
    return float(every[1].mean(1)[inside].mean())
