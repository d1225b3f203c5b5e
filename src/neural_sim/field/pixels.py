"""The pixels of a batch of views that may see a field, chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.devices import at_once
from neural_sim.field.base import RadianceField
from neural_sim.field.quadrature import Span
from neural_sim.types import PinholeCamera

SMALLEST_STRIP, LARGEST_STRIP = 2048, 16384
"""Smallest and largest number of pixels of an image that are processed together, in whole rows, so that a large image
needs no more memory than a small one. The largest is for a CPU; see ``at_once`` for other devices."""


@dataclass(frozen=True)
class SeenPixels:
    """Flat pixel indices into [views, height, width], and the spans of the pixels' rays if known."""

    pixel: Int[Tensor, "rays"]
    span: Span | None


def seen_pixels(
    field: RadianceField,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "views 4 4"],
    rays_per_chunk: int,
    cull: bool = True,
) -> Iterator[SeenPixels]:
    """Yield at most ``rays_per_chunk`` pixels at a time, in order; with ``cull`` only those that may see the field."""
    strip = max(SMALLEST_STRIP, min(rays_per_chunk, at_once(LARGEST_STRIP, camera_to_world.device)))
    rows_per_strip = max(1, strip // camera.width)
    waiting: list[SeenPixels] = []
    for view, pose in enumerate(camera_to_world):
        for top in range(0, camera.height, rows_per_strip):
            rows = range(top, min(top + rows_per_strip, camera.height))
            waiting.append(_strip(field, camera, pose, view, rows, cull))
            if sum(len(part.pixel) for part in waiting) >= rays_per_chunk:
                *whole, rest = _split(_join(waiting), rays_per_chunk)
                yield from whole
                waiting = [rest]
    if waiting:
        yield from _split(_join(waiting), rays_per_chunk)


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
