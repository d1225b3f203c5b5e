"""The pixels of a batch of views that may see a field, chunk by chunk, and their rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.cameras import focal_length
from neural_sim.field.base import RadianceField
from neural_sim.field.samples import Span
from neural_sim.types import PinholeCamera, Rays

STRIP = 16384
"""Pixels of an image looked at together, in whole rows: a large image needs no more memory than a small one."""


@dataclass(frozen=True)
class SeenPixels:
    """Flat indices into [views, height, width], and what is known of their rays."""

    pixel: Int[Tensor, "rays"]
    span: Span | None


def seen_pixels(
    field: RadianceField,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    rays_per_chunk: int,
    cull: bool = True,
) -> Iterator[SeenPixels]:
    """Chunks of at most ``rays_per_chunk`` pixels, in order; with ``cull`` only those that may see the field."""
    rows_per_strip = max(1, STRIP // camera.width)
    waiting: list[SeenPixels] = []
    for view, pose in enumerate(camera_to_world):
        for top in range(0, camera.height, rows_per_strip):
            rows = range(top, min(top + rows_per_strip, camera.height))
            waiting.append(_strip(field, camera, pose, view, rows, cull))
            if sum(len(part.pixel) for part in waiting) >= rays_per_chunk:
                *whole, rest = _split(_join(waiting), rays_per_chunk)
                yield from whole
                waiting = [rest]
    yield from _split(_join(waiting), rays_per_chunk)


def pixel_rays(
    camera: PinholeCamera, camera_to_world: Float[Tensor, "views 4 4"], pixel: Int[Tensor, "rays"]
) -> Rays:
    """Rays of the pixels with the given flat indices: those of ``cameras.rays``, linear in the pose like them."""
    per_view = camera.height * camera.width
    view, inside = torch.div(pixel, per_view, rounding_mode="floor"), pixel % per_view
    row = torch.div(inside, camera.width, rounding_mode="floor")
    focal, dtype = focal_length(camera), camera_to_world.dtype
    across = ((inside % camera.width).to(dtype) + (0.5 - 0.5 * camera.width)) / focal
    up = (row.to(dtype) + (0.5 - 0.5 * camera.height)) / -focal
    length = torch.sqrt(across * across + up * up + 1.0)
    across, up, ahead = across / length, up / length, -1.0 / length
    pose = camera_to_world[:, :3].permute(1, 2, 0).contiguous()
    directions = [
        (line[0].index_select(0, view) * across)
        .addcmul_(line[1].index_select(0, view), up)
        .addcmul_(line[2].index_select(0, view), ahead)
        for line in pose
    ]
    return Rays(camera_to_world[:, :3, 3].index_select(0, view), torch.stack(directions, -1))


def _strip(
    field: RadianceField, camera: PinholeCamera, pose: Tensor, view: int, rows: range, cull: bool
) -> SeenPixels:
    first = (view * camera.height + rows.start) * camera.width
    span = field.span(camera, pose, rows) if cull else None
    if span is None:
        return SeenPixels(first + torch.arange(len(rows) * camera.width, device=pose.device), None)
    index = (span.near <= span.far).nonzero()[:, 0]
    return SeenPixels(first + index, span.select(index))


def _join(parts: list[SeenPixels]) -> SeenPixels:
    pixel = torch.cat([part.pixel for part in parts])
    spans = [part.span for part in parts if part.span is not None]
    if len(spans) < len(parts):
        return SeenPixels(pixel, None)
    return SeenPixels(pixel, Span(torch.cat([s.near for s in spans]), torch.cat([s.far for s in spans])))


def _split(seen: SeenPixels, size: int) -> list[SeenPixels]:
    pixels = seen.pixel.split(size)
    if seen.span is None:
        return [SeenPixels(pixel, None) for pixel in pixels]
    ends = zip(seen.span.near.split(size), seen.span.far.split(size), strict=True)
    return [SeenPixels(pixel, Span(*pair)) for pixel, pair in zip(pixels, ends, strict=True)]
