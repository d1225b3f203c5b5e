"""Read photographs from files to tensors: find the files, and letterbox their pixels and boxes."""

from __future__ import annotations

import glob
import logging
import os
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image, ImageOps
from torch import Tensor

from neural_sim.pictures import PHOTO_SUFFIXES, by, eight_bits, picture_files, read_picture
from neural_sim.types import LabelledImages

_log = logging.getLogger(__name__)

GREY = 0.5


# --- files ---


@dataclass(frozen=True)
class PhotoFiles:
    """The photographs in a folder, at any depth, or those that a glob (``**`` descends) or a path names.

    Args:
        where: the folder, glob or path; ``~`` is the user's home.
        key: the setting that holds it, for messages.

    Raises:
        ValueError: nothing has this name, or there is no photograph.
    """

    where: str
    key: str

    def __post_init__(self) -> None:
        if not self.paths:
            if self._folder.is_dir():
                raise ValueError(f"{self.key}: no picture ({', '.join(PHOTO_SUFFIXES)}) in {self.where}")
            raise ValueError(
                f"{self.key}: want a folder of pictures, a glob or a picture, got {self.where}, "
                + ("which no file matches" if glob.has_magic(self.where) else "which does not exist")
            )

    @property
    def _folder(self) -> Path:
        return Path(self.where).expanduser()

    @cached_property
    def paths(self) -> Sequence[Path]:
        """The files in the order of their names."""
        if self._folder.is_dir():
            return picture_files(self._folder)
        if self._folder.is_file():  # its name may contain glob characters
            return [self._folder]
        found = glob.glob(str(self._folder), recursive=True)
        return sorted(path for path in map(Path, found) if path.is_file())

    @cached_property
    def root(self) -> Path:
        """The folder below which all photographs lie."""
        if self._folder.is_dir():
            return self._folder
        return Path(os.path.commonpath([path.parent for path in self.paths]))

    def name(self, path: Path) -> str:
        """Return a photograph's path below ``root``, with ``/``."""
        return path.relative_to(self.root).as_posix()

    def read(self, path: Path) -> Image.Image:
        """Read a photograph in RGB, upright. Raises ``ValueError`` if it cannot be read."""
        return read_picture(path, f"{self.key}: {path}").convert("RGB")


# --- pixels and boxes ---


@dataclass(frozen=True)
class Letterbox:
    """The position of a photograph of ``width`` x ``height`` in the new image (pixels)."""

    width: int
    height: int
    left: int
    top: int
    inner_width: int
    inner_height: int

    def boxes(self, boxes: Float[Tensor, "b 4"]) -> Float[Tensor, "b 4"]:
        """Map (x0, y0, x1, y1) from the photograph, clipped to it, to the new image."""
        size, inner, offset = self._sides(boxes)
        return torch.minimum(boxes.clamp_min(0.0), size) * (inner / size) + offset

    def of_photo(self, boxes: Float[Tensor, "b 4"]) -> Float[Tensor, "b 4"]:
        """Map (x0, y0, x1, y1) from the new image to the photograph, clipped to it: the inverse of ``boxes``."""
        size, inner, offset = self._sides(boxes)
        return torch.minimum(((boxes - offset) * (size / inner)).clamp_min(0.0), size)

    def inside(self, image: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 _ _"]:
        """Return the part of the new image that the photograph fills."""
        return image[:, self.top : self.top + self.inner_height, self.left : self.left + self.inner_width]

    def _sides(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the sizes of the photograph and of its part in the new image, and the part's origin, for boxes."""
        size = like.new_tensor([self.width, self.height, self.width, self.height])
        inner = like.new_tensor([self.inner_width, self.inner_height] * 2)
        return size, inner, like.new_tensor([self.left, self.top] * 2)


def letterbox(
    photo: Image.Image, height: int, width: int
) -> tuple[Float[Tensor, "3 height width"], Letterbox]:
    """Scale a photograph to one size without distortion, centred on grey; values are in [0, 1]."""
    scale = min(width / photo.width, height / photo.height)
    inner_width = max(1, min(width, round(scale * photo.width)))
    inner_height = max(1, min(height, round(scale * photo.height)))
    left, top = (width - inner_width) // 2, (height - inner_height) // 2
    resized = eight_bits(photo).convert("RGB").resize((inner_width, inner_height), Image.Resampling.BILINEAR)
    image = torch.full((3, height, width), GREY)
    pixels = torch.from_numpy(np.asarray(resized, dtype=np.float32) / 255.0).movedim(-1, 0)
    image[:, top : top + inner_height, left : left + inner_width] = pixels
    return image, Letterbox(photo.width, photo.height, left, top, inner_width, inner_height)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A labelled photograph of a data set, not yet read.

    Args:
        path: its file.
        labels: the class of each box, a position in the run's objects.
        boxes: (x0, y0, x1, y1) in the upright picture's pixels, along their edges; None: one box,
            which is the whole photograph.
        bins: the pose bin of each box, counted from 0; -1 if it is unknown; None: no box has one.
        name: its name in messages.
        group: the group that a split keeps together.
        where: how messages about the file begin; empty: with its path.
        border: number of pixels to cut off each side.
    """

    path: Path
    labels: Int[Tensor, "b"]
    boxes: Float[Tensor, "b 4"] | None = None
    bins: Int[Tensor, "b"] | None = None
    name: str = ""
    group: Hashable = None
    where: str = ""
    border: int = 0

    def letterboxed(self, height: int, width: int) -> tuple[Float[Tensor, "3 height width"], Letterbox]:
        """Read the photograph at one size, upright.

        Raises:
            ValueError: the file cannot be read, or nothing is left within the border.
        """
        photo = read_picture(self.path, self.where).convert("RGB")
        if self.border == 0:
            return letterbox(photo, height, width)
        if min(photo.size) <= 2 * self.border:
            raise ValueError(
                f"target.border: {self.border} leaves nothing of {self.path}, which has {by(photo.size)} pixels"
            )
        return letterbox(ImageOps.crop(photo, self.border), height, width)


def read(
    photographs: Sequence[Photograph], height: int, width: int, minimum_side: float, source: object
) -> tuple[LabelledImages, list[Letterbox]]:
    """Read photographs as one labelled set of images of one size.

    Args:
        photographs: at least one.
        height: height of the images, in pixels.
        width: width of the images, in pixels.
        minimum_side: boxes with a shorter side, in pixels of the images, are dropped and counted in the log, and so are
            boxes outside their photographs. A box that is the whole photograph is kept.
        source: the data set, for the log.

    Returns:
        The set, with boxes padded to the longest list among them, and bins by box if some photograph has any; and the
        position of each photograph in its image.

    Raises:
        ValueError: there are no photographs, or one cannot be read.
    """
    if not photographs:
        raise ValueError("target: want at least one photograph, got none")
    images, placings, kept, dropped = [], [], [], 0
    for photograph in photographs:
        image, placing = photograph.letterboxed(height, width)
        labelled = _placed(photograph, placing, minimum_side)
        images.append(image)
        placings.append(placing)
        kept.append(labelled)
        dropped += len(photograph.labels) - len(labelled.labels)
    if dropped:
        _log.warning(
            "%s: %d boxes with a side below %g px or outside their photographs are dropped",
            source, dropped, minimum_side,
        )  # fmt: skip
    return padded(torch.stack(images), kept), placings


@dataclass(frozen=True, eq=False)
class Boxes:
    """The labelled boxes of one image, in its pixels."""

    boxes: Float[Tensor, "b 4"]
    labels: Int[Tensor, "b"]
    bins: Int[Tensor, "b"] | None = None


def _placed(photograph: Photograph, placing: Letterbox, minimum_side: float) -> Boxes:
    """Map a photograph's boxes into the letterboxed image, without those that are too small or outside it."""
    if photograph.boxes is None:
        whole = torch.tensor([[0.0, 0.0, placing.width, placing.height]])
        return Boxes(placing.boxes(whole), photograph.labels, photograph.bins)
    boxes = placing.boxes(photograph.boxes)
    sides = boxes[:, 2:] - boxes[:, :2]
    large = ((sides >= minimum_side) & (sides > 0.0)).all(-1)
    bins = None if photograph.bins is None else photograph.bins[large]
    return Boxes(boxes[large], photograph.labels[large], bins)


def padded(images: Float[Tensor, "n 3 h w"], kept: Sequence[Boxes]) -> LabelledImages:
    """Combine images and their boxes into a labelled set.

    Boxes are padded to the longest list among them; bins are by box if some image has any.
    """
    most = max([1, *(len(one.labels) for one in kept)])
    boxes = torch.zeros(len(kept), most, 4)
    labels, bins = (torch.full((len(kept), most), -1) for _ in range(2))
    for row, one in enumerate(kept):
        count = len(one.labels)
        boxes[row, :count], labels[row, :count] = one.boxes, one.labels
        bins[row, :count] = -1 if one.bins is None else one.bins
    by_box = any(one.bins is not None for one in kept)
    return LabelledImages(images, boxes, labels, bins if by_box else torch.full((len(kept),), -1))
