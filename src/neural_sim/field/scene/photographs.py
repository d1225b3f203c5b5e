"""Read photographs, reduced, as pixels with rays that undo the lens distortion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.field.scene.fitting import ScenePixels
from neural_sim.objects.capture import Capture, Frame, Lens
from neural_sim.objects.pictures import reduced


@dataclass(frozen=True)
class PhotoRays:
    """Rays of a reduced photograph's pixels, in the capture's frame; ``seen`` marks the pixels that have a ray."""

    origin: Float[Tensor, "3"]
    directions: Float[Tensor, "h w 3"]
    seen: Bool[Tensor, "h w"]


def reduced_size(frame: Frame, longest: int) -> tuple[int, int]:
    """Return width and height of a photograph reduced to at most ``longest`` pixels along its longer side."""
    part = min(1.0, longest / max(frame.lens.width, frame.lens.height))
    return max(1, round(part * frame.lens.width)), max(1, round(part * frame.lens.height))


def photo_rays(frame: Frame, longest: int) -> PhotoRays:
    """Return rays through the centres of the reduced photograph's pixels."""
    local, seen = _local_rays(frame.lens, *reduced_size(frame, longest))
    pose = torch.from_numpy(frame.camera_to_world)
    return PhotoRays(pose[:3, 3], local @ pose[:3, :3].t(), seen)


@lru_cache(maxsize=4)  # most captures have one lens
def _local_rays(lens: Lens, width: int, height: int) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    x = (torch.arange(width, dtype=torch.float64) + 0.5) * (lens.width / width)
    y = (torch.arange(height, dtype=torch.float64) + 0.5) * (lens.height / height)
    return lens.directions(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1))


def scene_pixels(capture: Capture, longest: int) -> ScenePixels:
    """Collect all pixels of a capture's photographs, reduced."""
    parts = []
    for number, frame in enumerate(capture.frames):
        rays, colours = photo_rays(frame, longest), reduced(frame, reduced_size(frame, longest))
        seen = rays.seen
        count = int(seen.sum())
        photo = torch.full((count,), number, dtype=torch.long)
        down, right = torch.gradient(colours.mean(-1))
        detail = (down.square() + right.square()).sqrt()[seen]
        parts.append((rays.origin.expand(count, 3), rays.directions[seen], colours[seen], photo, detail))
    return ScenePixels(*(torch.cat(part) for part in zip(*parts, strict=True)))
