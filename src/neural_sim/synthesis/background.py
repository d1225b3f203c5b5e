"""Backgrounds: procedural clutter, or crops of photographs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from neural_sim.devices import moved
from neural_sim.objects.files import content_digest
from neural_sim.pictures import PHOTO_SUFFIXES, check_headers, picture_files, read_picture
from neural_sim.ranges import Fraction, NonNegative, NonNegativeInt, PositiveFraction, PositiveInt, validated

# Images drawn together: few enough to stay in the cache. Not a setting, because what a seed draws depends on it.
CHUNK = 16


class Background(Protocol):
    """A source of backgrounds on a device, sRGB in [0, 1]; equal CPU generators give equal images on any device."""

    def draw(
        self,
        n: int,
        height: int,
        width: int,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> Float[Tensor, "n 3 height width"]:
        """Draw ``n`` backgrounds."""
        ...


@validated
class ProceduralClutter:
    """Indoor-like clutter: smooth noise in random colours under textured, shaded rectangles and ellipses.

    Args:
        octaves: number of octaves of noise; the first has 2 cells across the image, and each doubles them.
        contrast: amplitude of the noise.
        shapes: number of shapes in an image, drawn from far to near.
        distractors: fraction of shapes that are saturated red or blue, so that no object can be found by colour alone.
        grain: standard deviation of pixel noise.
    """

    def __init__(
        self,
        octaves: PositiveInt = 5,
        contrast: NonNegative = 0.35,
        shapes: NonNegativeInt = 10,
        distractors: Fraction = 0.4,
        grain: NonNegative = 0.02,
    ) -> None:
        self.octaves, self.contrast, self.shapes = octaves, contrast, shapes
        self.distractors, self.grain = distractors, grain

    def draw(
        self,
        n: int,
        height: int,
        width: int,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> Float[Tensor, "n 3 height width"]:
        """Draw ``n`` images, float32; random numbers come from the CPU, everything else is computed on ``device``."""
        images = torch.empty(n, 3, height, width, device=device)
        for start in range(0, n, CHUNK):
            part = images[start : start + CHUNK]
            part.copy_(self._chunk(len(part), height, width, generator, device))
        return images

    def _chunk(
        self, n: int, height: int, width: int, generator: torch.Generator, device: torch.device | str
    ) -> Tensor:
        drawn = [torch.rand(shape, generator=generator) for shape in self._numbers(n)]
        grain = torch.randn((n, 3, height, width), generator=generator).to(device)
        uniform = moved(drawn, device)
        wall, shapes = uniform[: 2 + 2 * self.octaves], uniform[2 + 2 * self.octaves :]
        images = self._wall(wall, height, width)
        for depth in range(self.shapes):
            # Far shapes are large and near ones small, so that no shape hides all the others.
            size = 0.45 * 0.5 ** (2.0 * depth / max(self.shapes - 1, 1))
            cover, level = self._shape(shapes[2 * depth], height, width, size)
            colour = self._colour(shapes[2 * depth + 1])
            images += cover[:, None] * (colour * level[:, None] - images)
        images += self.grain * grain
        return images.clamp_(0.0, 1.0)

    def _numbers(self, n: int) -> Iterator[tuple[int, ...]]:
        """Yield the shapes of the uniform numbers for n images, in the order in which they are drawn."""
        yield from ((n, 1, 1, 1), (n, 3, 1, 1))
        for octave in range(self.octaves):
            cells = 2 ** (octave + 1) + 1
            yield from ((n, 1, cells, cells), (n, 3, cells, cells))
        for _ in range(self.shapes):
            yield from ((12, n, 1, 1), (5, n))

    def _wall(self, numbers: Sequence[Tensor], height: int, width: int) -> Tensor:
        """Draw a random colour with noise of every scale, mostly grey."""
        base, tint = 0.2 + 0.6 * numbers[0], 0.25 * (numbers[1] - 0.5)
        images = (base + tint).expand(-1, -1, height, width).clone()
        for octave in range(self.octaves):
            grey, hue = numbers[2 + 2 * octave : 4 + 2 * octave]
            noise = (0.7 * grey + 0.3 * hue - 0.5) * (2.0 * self.contrast * 0.65**octave)
            images += torch.nn.functional.interpolate(
                noise, (height, width), mode="bilinear", align_corners=True
            )
        return images

    def _shape(
        self, u: Float[Tensor, "12 n 1 1"], height: int, width: int, size: float
    ) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
        """Return the coverage and brightness of one textured shape in each image."""
        extent = float(min(height, width))
        angle = math.pi * torch.where(u[0] < 0.5, 0.08 * (u[1] - 0.5), u[1])  # half of them nearly upright
        x = torch.arange(width, device=u.device) + 0.5 - width * (1.2 * u[2] - 0.1)
        y = (torch.arange(height, device=u.device) + 0.5)[:, None] - height * (1.2 * u[3] - 0.1)
        along, across = angle.cos() * x + angle.sin() * y, angle.cos() * y - angle.sin() * x
        half_x, half_y = (extent * size * (0.3 + 0.9 * u[i]) for i in (4, 5))
        box = torch.maximum(along.abs() - half_x, across.abs() - half_y)
        round_ = ((along / half_x).square() + (across / half_y).square()).sqrt_().sub_(1.0)
        distance = torch.where(u[6] < 0.6, box, round_ * torch.minimum(half_x, half_y))
        cover = (0.5 - distance).clamp_(0.0, 1.0)
        period = extent * (0.04 + 0.2 * u[7])
        stripes = (2.0 * math.pi / period * along + 6.28 * u[8]).sin_().mul_(4.0).clamp_(-1.0, 1.0)
        checks = stripes * torch.where(u[9] < 0.5, across.sign(), 1.0)
        texture = torch.where(u[9] < 0.7, 0.25 * u[10], 0.0)  # three in ten are plain
        level = 0.85 + texture * checks + 0.3 * (u[11] - 0.5) * across / half_y
        return cover, level

    def _colour(self, u: Float[Tensor, "5 n"]) -> Float[Tensor, "n 3 1 1"]:
        """Draw colours of any hue, mostly dull; a fraction ``distractors`` is saturated, near red or near blue."""
        strong = u[0] < self.distractors
        centre = torch.where(u[1] < 0.5, torch.zeros_like(u[1]), 0.61)
        hue = torch.where(strong, centre + 0.1 * (u[2] - 0.5), u[2])
        saturation = torch.where(strong, 0.5 + 0.5 * u[3], 0.6 * u[3].square())
        value = 0.25 + 0.7 * u[4]
        wheel = torch.stack([hue, hue + 2 / 3, hue + 1 / 3], 1) % 1.0
        pure = ((6.0 * wheel - 3.0).abs() - 1.0).clamp(0.0, 1.0)
        return (value[:, None] * (1.0 - saturation[:, None] * (1.0 - pure)))[..., None, None]


@validated
class PhotoFolder:
    """Random crops of the photographs under a folder, resized.

    ``smallest`` is the side of the smallest crop, as a fraction of that of the largest.

    Raises:
        ValueError: the folder does not exist or has no photograph, or a file's header cannot be read.
    """

    def __init__(self, root: str | Path, smallest: PositiveFraction = 0.4) -> None:
        self.root, self.smallest = Path(root).expanduser(), smallest
        if not self.root.is_dir():
            raise ValueError(f"PhotoFolder.root: want a folder of photographs, got {self.root}")
        self.files = picture_files(self.root)
        if not self.files:
            raise ValueError(f"PhotoFolder.root: no photograph ({', '.join(PHOTO_SUFFIXES)}) in {self.root}")
        check_headers(self.files, "PhotoFolder.root")

    def draw(
        self,
        n: int,
        height: int,
        width: int,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> Float[Tensor, "n 3 height width"]:
        """Draw ``n`` crops, float32.

        Raises:
            ValueError: a photograph cannot be read; the message has its file.
        """
        chosen = torch.randint(len(self.files), (n,), generator=generator).tolist()
        uniform = torch.rand((n, 3), generator=generator, dtype=torch.float64).tolist()
        images = torch.empty(n, 3, height, width)
        crops: dict[int, list[int]] = {}
        for index, file in enumerate(chosen):
            crops.setdefault(file, []).append(index)
        for file, indices in crops.items():  # every file is decoded once
            photo = read_picture(self.files[file]).convert("RGB")
            for index in indices:
                images[index] = self._crop(photo, height, width, *uniform[index])
        return images.to(device)

    @cached_property
    def _digest(self) -> str:
        return content_digest({path.relative_to(self.root).as_posix(): path for path in self.files})

    def digest(self) -> str:
        """Return the SHA-256 of the photographs' names and contents, for store keys."""
        return self._digest

    def _crop(self, photo: Image.Image, height: int, width: int, u: float, v: float, w: float) -> Tensor:
        scale = min(photo.width / width, photo.height / height) * (self.smallest + (1.0 - self.smallest) * w)
        # Rounding may make the largest crop a little larger than the photograph, which Pillow refuses.
        across, down = min(scale * width, photo.width), min(scale * height, photo.height)
        left, top = u * (photo.width - across), v * (photo.height - down)
        box = (left, top, left + across, top + down)
        crop = photo.resize((width, height), Image.Resampling.BILINEAR, box=box)
        return torch.from_numpy(np.asarray(crop, dtype=np.float32) / 255.0).movedim(-1, 0)
