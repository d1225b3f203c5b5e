"""Pixels of a capture's photographs: colours and the object's mask."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn import functional

from neural_sim.documents import read_json
from neural_sim.masks import read_mask
from neural_sim.objects.capture import Capture, Frame
from neural_sim.pictures import Size, alpha_of, by, read_header, read_picture
from neural_sim.ranges import Matching, check, validated

Masks = Literal["auto", "alpha", "files", "scene", "command"]
MADE = ("scene", "command")
"""Sources whose masks are computed for all photographs together, not looked up for each."""
Direction = tuple[float, float, float]
Corners = tuple[Direction, Direction]
"""Lowest and highest corner of a box along the axes of the capture's frame, in its unit."""
Box = Annotated[
    Corners,
    Matching(
        lambda box: all(low < high for low, high in zip(*box, strict=True)),
        "[[x0, y0, z0], [x1, y1, z1]] with x0 < x1, y0 < y1 and z0 < z1",
    ),
]
BOX_FILE = "box.json"
"""File with the object's box in the capture's folder, saved by the page of ``stages=[box]``."""
MASKS_FOLDER = "masks"
SHARPNESS = 4.0
"""Factor that steepens the opacity of scene masks around one half: objects become opaque, and fog vanishes."""


@runtime_checkable
class SceneMaskMaker(Protocol):
    """Computes masks from photographs and cameras alone."""

    def masks(
        self, capture: Capture, up: Direction | None, box: Corners | None
    ) -> tuple[Float[Tensor, "_ _"], ...]:
        """Compute the object's opacity in [0, 1] for each frame of the capture, at any size.

        Raises:
            ValueError: no object was found.
        """
        ...


def box_of(box: Box | Mapping[str, Box | None] | None, name: str) -> Corners | None:
    """Return an object's box, from one for all objects or a mapping by name."""
    given = box.get(name) if isinstance(box, Mapping) else box
    if given is None:
        return None
    (x0, y0, z0), (x1, y1, z1) = given
    return (float(x0), float(y0), float(z0)), (float(x1), float(y1), float(z1))


def saved_box(folder: Path) -> Corners | None:
    """Read the box that was saved in a capture's folder; None if there is none.

    Raises:
        ValueError: the file holds no box; the message names the file.
    """
    file = folder / BOX_FILE
    if not file.is_file():
        return None
    document = read_json(file)
    given = document.get("box") if isinstance(document, dict) else None
    check(given, Box, f"{file}: box")
    return box_of(given, "")


@validated
@dataclass(frozen=True)
class Pictures:
    """Reads the photographs of a capture.

    ``masks`` is the source of the object's mask. ``files``: the frame's ``mask_path``, or an image with its name in a
    folder ``masks`` next to the images or the capture's file; ``alpha``: the image's alpha channel; ``auto``: the
    first of these that a frame has; ``scene`` and ``command``: ``computed``, with a mask of any size for each of the
    capture's frames, in their order. In label images, the object's pixels have ``value``.

    Raises:
        ValueError: the number of computed masks is wrong. ``rgba`` raises it if a frame has no mask, or one of another
            size.
    """

    capture: Capture
    masks: Masks = "auto"
    computed: tuple[Float[Tensor, "_ _"], ...] = ()
    value: int | None = None

    def __post_init__(self) -> None:
        wanted = len(self.capture.frames) if self.masks in MADE else 0
        if len(self.computed) != wanted:
            raise ValueError(
                f"objects.masks={self.masks}: want {wanted} computed masks for the {len(self.capture.frames)} "
                f"photographs of {self.capture.name}, got {len(self.computed)}"
            )

    def rgba(self, frame: Frame) -> Float[Tensor, "h w 4"]:
        """Return colour and mask of a frame: straight alpha, float32 in [0, 1]."""
        picture = read_picture(frame.image, upright=False)
        colours = _values(picture.convert("RGB"))
        if self.masks in MADE:
            number = next(i for i, other in enumerate(self.capture.frames) if other is frame)
            alpha = self.computed[number]
            size = (picture.height, picture.width)
            if alpha.shape != size:
                alpha = functional.interpolate(alpha[None, None], size, mode="bilinear", align_corners=False)[
                    0, 0
                ]
            if self.masks == "scene":
                alpha = (0.5 + SHARPNESS * (alpha - 0.5)).clamp(0.0, 1.0)
            return torch.cat([colours, alpha[:, :, None]], -1)
        mask = given_mask(frame.image, mask_of(frame, self.capture.source), picture, self.masks, self.value)
        if mask is None:
            raise ValueError(
                f"{frame.image}: has no mask of the object; want an alpha channel that is not opaque everywhere, a "
                f"mask_path, or a mask with its name in a folder {MASKS_FOLDER!r}; objects.masks=scene computes masks"
            )
        return torch.cat([colours, mask[:, :, None]], -1)


def given_mask(
    image: Path, file: Path | None, picture: Image.Image, masks: Masks, value: int | None
) -> Float[Tensor, "h w"] | None:
    """Return a photograph's mask, from its ``file`` or its own alpha channel; None if there is none.

    Raises:
        ValueError: the file is not a mask of the photograph.
    """
    if file is not None and masks != "alpha":
        mask = read_mask(file, value)
        refuse_size(file, (mask.shape[1], mask.shape[0]), image, picture.size)
        return torch.from_numpy(mask)
    own = alpha_of(picture) if masks != "files" else None
    return None if own is None else _values(own)


def check_masks(capture: Capture) -> None:
    """Check the files of a capture's masks by their headers.

    Raises:
        ValueError: a file is not a picture or not of its photograph's size, or a file in a folder of masks would belong
            to several photographs.
    """
    found: dict[Path, Path] = {}
    for frame in capture.frames:
        file = mask_of(frame, capture.source)
        if file is None:
            continue
        refuse_size(file, read_header(file).stored, frame.image, (frame.lens.width, frame.lens.height))
        if frame.mask is None:
            refuse_shared(found, file, frame.image)


def refuse_shared(found: dict[Path, Path], file: Path, image: Path) -> None:
    """Record in ``found`` whose mask a file is; raise ``ValueError`` if it already belongs to another photograph."""
    other = found.setdefault(file, image)
    if other != image:
        raise ValueError(
            f"{file}: its name makes it the mask of both {other} and {image}; want one for each in {MASKS_FOLDER!r}, "
            f"in the same subfolders as the photographs, such as {image.parent.name}/{image.name}.png"
        )


def refuse_size(file: Path, size: Size, image: Path, wanted: Size) -> None:
    """Raise ``ValueError`` for a mask that does not have its image's size."""
    if size != wanted:
        raise ValueError(f"{file}: the mask has {by(size)} pixels, but its image {image} has {by(wanted)}")


def mask_of(frame: Frame, source: Path) -> Path | None:
    """Find the file of a frame's mask; None if there is none."""
    return frame.mask or mask_beside(frame.image, source)


def mask_beside(image: Path, source: Path) -> Path | None:
    """Find the mask of ``image.jpg`` in a folder of masks: ``image.jpg.png`` (COLMAP), ``image.png`` or ``image.jpg``.

    The folder is next to the image or to one of the folders around it, up to the one that also holds ``source``. In it,
    a mask may lie in the same subfolders as its image.
    """
    whole = os.path.abspath(image.parent)
    home = os.path.commonpath([whole, os.path.abspath(source if source.is_dir() else source.parent)])
    levels = len(Path(whole).parts) - len(Path(home).parts) + 1
    for folder in [image.parent, *image.parent.parents][: max(2, levels)]:
        below = image.parent.relative_to(folder)
        # The images' own folder may be missing among the masks, or all subfolders.
        inner = [below, Path(*below.parts[1:]), Path()]
        for part in dict.fromkeys(inner):
            for name in (f"{image.name}.png", f"{image.stem}.png", image.name):
                if (folder / MASKS_FOLDER / part / name).is_file():
                    return folder / MASKS_FOLDER / part / name
    return None


def _values(image: Image.Image) -> Float[Tensor, "h w *c"]:
    return torch.from_numpy(np.asarray(image, dtype=np.float32) / 255.0)


def reduced(frame: Frame, size: tuple[int, int]) -> Float[Tensor, "h w 3"]:
    """Read a photograph's colours, averaged to ``size`` (width, height)."""
    return _values(read_picture(frame.image, upright=False).convert("RGB").resize(size, Image.Resampling.BOX))
