"""Blur and noise of a camera, drawn before images are made, so that every pass can be replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.ranges import Ascending, NonNegative, validated

Deviations = Annotated[tuple[NonNegative, NonNegative], Ascending()]
"""Smallest and largest standard deviation."""


@dataclass(frozen=True)
class SensorDraw:
    """Blur and noise of n images.

    ``blur`` is the standard deviation of a Gaussian in pixels; ``grain`` is added to sRGB values. Each is None if there
    is none.
    """

    blur: Float[Tensor, "n"] | None
    grain: Float[Tensor, "n 3 h w"] | None

    def select(self, index: Tensor | slice) -> SensorDraw:
        """Return the draw of some of the images."""
        return SensorDraw(*(None if part is None else part[index] for part in (self.blur, self.grain)))


@validated
@dataclass(frozen=True)
class Sensor:
    """Blur and noise of a camera, each with a strength uniform in a range.

    Args:
        blur: smallest and largest standard deviation of the blur, in pixels.
        noise: smallest and largest standard deviation of the noise, in sRGB values in [0, 1].
    """

    blur: Deviations = (0.0, 0.0)
    noise: Deviations = (0.0, 0.0)

    def draw(
        self, n: int, height: int, width: int, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> SensorDraw | None:
        """Draw blur and noise for n images; if there is neither, return None and draw no random number."""
        if self.blur[1] == self.noise[1] == 0.0:
            return None
        blur = grain = None
        if self.blur[1] > 0.0:
            blur = _uniform(self.blur, n, generator).to(device)
        if self.noise[1] > 0.0:
            size = _uniform(self.noise, n, generator)[:, None, None, None]
            grain = (size * torch.randn((n, 3, height, width), generator=generator)).to(device)
        return SensorDraw(blur, grain)


def seen_by(images: Float[Tensor, "n 3 h w"], sensor: SensorDraw | None) -> Float[Tensor, "n 3 h w"]:
    """Blur the images, then add noise, in [0, 1]; differentiable in the images where they do not saturate."""
    if sensor is None:
        return images
    if sensor.blur is not None:
        images = blurred(images, sensor.blur)
    if sensor.grain is not None:
        images = images + sensor.grain.to(images)
    return images.clamp(0.0, 1.0)


def blurred(images: Float[Tensor, "n c h w"], deviation: Float[Tensor, "n"]) -> Float[Tensor, "n c h w"]:
    """Convolve each image with its own Gaussian, cut off at three times its deviation; edge pixels repeat.

    An image is the same whichever others are blurred with it, so that it can be composed again without them.
    """
    n, channels, height, width = images.shape
    own = torch.ceil(3.0 * deviation).clamp_min(1.0)
    reach = int(own.max())
    offset = torch.arange(-reach, reach + 1, device=images.device, dtype=images.dtype)
    scale = deviation.to(images).clamp_min(1e-6)[:, None]
    kernel = torch.exp(-0.5 * (offset / scale).square()) * (offset.abs() <= own.to(images)[:, None])
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)[:, None]
    rows = images.reshape(1, n * channels, height, width)
    for edges, weights in (
        ((reach, reach, 0, 0), kernel[:, :, None]),
        ((0, 0, reach, reach), kernel[..., None]),
    ):
        padded = torch.nn.functional.pad(rows, edges, mode="replicate")
        rows = torch.nn.functional.conv2d(padded, weights, groups=n * channels)
    return rows.view(n, channels, height, width)


def _uniform(bounds: Sequence[float], n: int, generator: torch.Generator) -> Float[Tensor, "n"]:
    return bounds[0] + (bounds[1] - bounds[0]) * torch.rand(n, generator=generator)
