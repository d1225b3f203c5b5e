"""Pixels of a capture's photographs: colours and the object's mask."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Tensor
from torch.nn import functional

from neural_sim.objects.capture import Capture, Frame
from neural_sim.ranges import Matching, validated

Masks = Literal["auto", "alpha", "files", "scene"]
Direction = tuple[float, float, float]
Corners = tuple[Direction, Direction]
"""The lowest and the highest corner of a box along the axes of the capture's frame, in its unit."""
Box = Annotated[
    Corners,
    Matching(
        lambda box: all(low < high for low, high in zip(*box, strict=True)),
        "[[x0, y0, z0], [x1, y1, z1]] with x0 < x1, y0 < y1 and z0 < z1",
    ),
]
FOLDER = "masks"
SHARPNESS = 4.0
"""Slope of the masks' opacity about a half, where a computed mask has its edge: an object is opaque, fog is nothing."""


@runtime_checkable
class SceneMaskMaker(Protocol):
    """Computes masks from photographs and cameras alone."""

    def masks(
        self, capture: Capture, up: Direction | None, box: Corners | None
    ) -> tuple[Float[Tensor, "_ _"], ...]:
        """Compute the opacity of the object in [0, 1] for each of the capture's frames, at any size.

        Raises:
            ValueError: no object found.
        """
        ...


def box_of(box: Box | Mapping[str, Box | None] | None, name: str) -> Corners | None:
    """Return an object's box, from one for all objects or a mapping by name."""
    given = box.get(name) if isinstance(box, Mapping) else box
    if given is None:
        return None
    (x0, y0, z0), (x1, y1, z1) = given
    return (float(x0), float(y0), float(z0)), (float(x1), float(y1), float(z1))


@validated
@dataclass(frozen=True)
class Pictures:
    """Reads the photographs of a capture.

    ``masks`` is the source of the object's mask. ``files``: the frame's ``mask_path``, or an image of its name in a
    folder ``masks`` beside the images or beside the capture's file; ``alpha``: the image's alpha channel; ``auto``: the
    first of these that a frame has; ``scene``: ``computed``, a mask of any size for each of the capture's frames, in
    their order.

    Raises:
        ValueError: computed masks that are missing or too few; from :meth:`rgba`, a frame without a
            mask, or a mask of another size.
    """

    capture: Capture
    masks: Masks = "auto"
    computed: tuple[Float[Tensor, "_ _"], ...] = ()

    def __post_init__(self) -> None:
        wanted = len(self.capture.frames) if self.masks == "scene" else 0
        if len(self.computed) != wanted:
            raise ValueError(
                f"objects.masks={self.masks}: want {wanted} computed masks for the {len(self.capture.frames)} "
                f"photographs of {self.capture.name}, got {len(self.computed)}"
            )

    def rgba(self, frame: Frame) -> Float[Tensor, "h w 4"]:
        """Colour and mask of a frame: straight alpha, float32 in [0, 1]."""
        picture = _open(frame.image)
        if self.masks == "scene":
            number = next(i for i, other in enumerate(self.capture.frames) if other is frame)
            mask = self.computed[number][None, None]
            size = (picture.height, picture.width)
            alpha = functional.interpolate(mask, size, mode="bilinear", align_corners=False)[0, 0, :, :, None]
            alpha = (0.5 + SHARPNESS * (alpha - 0.5)).clamp(0.0, 1.0)
            return torch.cat([_values(picture.convert("RGB")), alpha], -1)
        file = mask_of(frame, self.capture.source) if self.masks != "alpha" else None
        if file is not None:
            mask = _open(file)
            if mask.size != picture.size:
                raise ValueError(
                    f"{file}: the mask has {mask.size[0]} x {mask.size[1]} pixels, its image {frame.image} "
                    f"{picture.size[0]} x {picture.size[1]}"
                )
            alpha = _values(mask.getchannel("A") if mask.mode in ("LA", "RGBA") else mask.convert("L"))[
                ..., None
            ]
        elif self.masks != "files" and picture.mode in ("RGBA", "LA", "PA"):
            alpha = _values(picture.convert("RGBA").getchannel("A"))[..., None]
        else:
            raise ValueError(
                f"{frame.image}: nothing says which of its pixels are the object's; want an alpha channel, a "
                f"mask_path, or a mask of its name in a folder {FOLDER!r}; objects.masks=scene finds masks without any"
            )
        return torch.cat([_values(picture.convert("RGB")), alpha], -1)


def mask_of(frame: Frame, source: Path) -> Path | None:
    """The file of a frame's mask, None without one. COLMAP calls it ``image.jpg.png``, others ``image.png``."""
    if frame.mask is not None:
        return frame.mask
    image = frame.image
    root = source if source.is_dir() else source.parent
    folders = dict.fromkeys([image.parent / FOLDER, image.parent.parent / FOLDER, root / FOLDER])
    for folder in folders:
        for name in (f"{image.name}.png", f"{image.stem}.png", image.name):
            if (folder / name).is_file():
                return folder / name
    return None


def _open(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{path}: not a readable image ({error})") from error


def _values(image: Image.Image) -> Float[Tensor, "h w *c"]:
    return torch.from_numpy(np.asarray(image, dtype=np.float32) / 255.0)


def reduced(frame: Frame, size: tuple[int, int]) -> Float[Tensor, "h w 3"]:
    """A photograph's colours, averaged to ``size`` (width, height)."""
    return _values(_open(frame.image).convert("RGB").resize(size, Image.Resampling.BOX))
