"""Distractors: unlabelled cut-outs of pictures with an alpha channel, behind and in front of the objects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Gt, Le
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from neural_sim.objects.files import content_digest
from neural_sim.pictures import CUTOUT_SUFFIXES, picture_files, read_header, read_picture, refuse_mode
from neural_sim.ranges import Ascending, Fraction, NonNegativeInt, validated

Size = Annotated[float, Gt(0), Le(4)]
KEPT = 2**26
"""Number of pixels of decoded pictures that are kept for the next images: 256 MB. A folder may hold any number."""


@dataclass(frozen=True)
class Cover:
    """A layer over images: premultiplied colour, sRGB in [0, 1], and opacity."""

    rgb: Float[Tensor, "n h w 3"]
    opacity: Float[Tensor, "n h w"]

    def select(self, index: Tensor | slice) -> Cover:
        """Return the layer of some of the images."""
        return Cover(self.rgb[index], self.opacity[index])

    def over(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
        """Lay the layer over images, in their type and on their device."""
        rgb, opacity = self.rgb.to(images), self.opacity.to(images)
        return rgb.movedim(-1, 1) + (1.0 - opacity)[:, None] * images


@validated
@dataclass(frozen=True)
class Distractors:
    """Random cut-outs from a folder, at random places and sizes, behind the objects or in front of them.

    Args:
        root: a folder with pictures that have an alpha channel (png, webp, tif); None: no distractors.
        count: smallest and largest number in an image.
        size: smallest and largest longer side, as a fraction of the image's shorter side.
        front: probability that a distractor is in front of the objects and hides what is behind it.

    Raises:
        ValueError: the folder does not exist or has no picture, or a file is not a picture with an alpha channel
            according to its header.
    """

    root: str | Path | None = None
    count: Annotated[tuple[NonNegativeInt, NonNegativeInt], Ascending()] = (0, 3)
    size: Annotated[tuple[Size, Size], Ascending()] = (0.15, 0.6)
    front: Fraction = 0.3

    def __post_init__(self) -> None:
        if self._folder is not None and not self._folder.is_dir():
            raise ValueError(f"Distractors.root: want a folder of pictures, got {self.root}")
        if self._folder is not None and not self.files:
            raise ValueError(f"Distractors.root: no picture ({', '.join(CUTOUT_SUFFIXES)}) in {self.root}")
        for path in self.files if self.used else ():
            header = read_header(path)
            refuse_mode(header.mode, header.format, str(path))
            if not header.transparent:
                raise ValueError(f"{path}: want a picture with an alpha channel, got mode {header.mode}")

    @property
    def _folder(self) -> Path | None:
        return None if self.root is None else Path(self.root).expanduser()

    @property
    def used(self) -> bool:
        """Whether an image may have a distractor."""
        return self.root is not None and self.count[1] > 0

    @property
    def hide(self) -> bool:
        """Whether a distractor may be in front of objects."""
        return self.used and self.front > 0.0

    @cached_property
    def files(self) -> list[Path]:
        """The pictures, sorted by name."""
        if self._folder is None:
            return []
        return picture_files(self._folder, CUTOUT_SUFFIXES)

    @cached_property
    def _digest(self) -> str | None:
        if self._folder is None:
            return None
        return content_digest({path.relative_to(self._folder).as_posix(): path for path in self.files})

    def digest(self) -> str | None:
        """Return the SHA-256 of the pictures' names and contents, for store keys; None without a folder."""
        return self._digest

    def draw(
        self, n: int, height: int, width: int, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> tuple[Cover, Cover] | None:
        """Draw the distractors behind the objects of n images, and those in front of them.

        Without distractors, return None and draw no random number.

        Raises:
            ValueError: a picture cannot be read; the message has its file.
        """
        if not self.used:
            return None
        layers = np.zeros((2, n, height, width, 4), dtype=np.float32)
        fewest, most = self.count
        counts = torch.randint(fewest, most + 1, (n,), generator=generator).tolist()
        chosen = torch.randint(len(self.files), (n, most), generator=generator).tolist()
        uniform = torch.rand((n, most, 4), generator=generator, dtype=torch.float64).tolist()
        for image, count in enumerate(counts):
            for file, (size, across, down, side) in zip(chosen[image][:count], uniform[image], strict=False):
                cutout = self._cutout(file, min(height, width) * self._side(size))
                _paste(layers[int(side < self.front), image], cutout, across, down)
        covers = torch.from_numpy(layers).to(device)
        behind, front = (Cover(layer[..., :3], layer[..., 3]) for layer in covers)
        return behind, front

    def _side(self, u: float) -> float:
        return self.size[0] + (self.size[1] - self.size[0]) * u

    def _cutout(self, file: int, side: float) -> Float[np.ndarray, "h w 4"]:
        """Return a premultiplied picture whose longer side has about ``side`` pixels."""
        picture = self._picture(file)
        scale = side / max(picture.size)
        size = max(1, round(scale * picture.width)), max(1, round(scale * picture.height))
        # "RGBa" is premultiplied, so that the colour of transparent pixels has no influence.
        resized = picture.convert("RGBa").resize(
            size, Image.Resampling.BOX if scale < 0.5 else Image.Resampling.BILINEAR
        )
        return np.asarray(resized, dtype=np.float32) / 255.0

    def _picture(self, file: int) -> Image.Image:
        kept = self._pictures
        if file not in kept:
            picture = read_picture(self.files[file]).convert("RGBA")
            free = (
                KEPT - picture.width * picture.height - sum(one.width * one.height for one in kept.values())
            )
            while kept and free < 0:
                oldest = kept.pop(next(iter(kept)))
                free += oldest.width * oldest.height
            kept[file] = picture
        return kept[file]

    @cached_property
    def _pictures(self) -> dict[int, Image.Image]:
        return {}


def _paste(
    layer: Float[np.ndarray, "h w 4"], cutout: Float[np.ndarray, "a b 4"], across: float, down: float
) -> None:
    """Paste a cut-out over a layer, in place, with its centre at a fraction of the layer's width and height."""
    height, width = layer.shape[:2]
    high, wide = cutout.shape[:2]
    left, top = round(across * width - 0.5 * wide), round(down * height - 0.5 * high)
    x0, x1, y0, y1 = max(0, left), min(width, left + wide), max(0, top), min(height, top + high)
    if x0 >= x1 or y0 >= y1:
        return
    part = cutout[y0 - top : y1 - top, x0 - left : x1 - left]
    there = layer[y0:y1, x0:x1]
    there *= 1.0 - part[..., 3:]
    there += part
