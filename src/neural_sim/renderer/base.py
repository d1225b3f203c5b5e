"""The base class of the mesh renderers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from neural_sim.cameras import resized
from neural_sim.ranges import PositiveInt, validated
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.surface import Surface, shaded_surface
from neural_sim.types import PinholeCamera


@validated
class MeshRenderer(ABC):
    """Draws meshes; each pixel averages ``supersample``^2 samples."""

    name: ClassVar[str]

    def __init__(self, supersample: PositiveInt = 2, lighting: Lighting | None = None) -> None:
        self.supersample = supersample
        self.lighting = Lighting() if lighting is None else lighting

    def render(
        self,
        mesh: trimesh.Trimesh,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        """Render RGBA images in [0, 1] with straight alpha, in float32 on the CPU; colour is 0 where alpha is 0.

        ``lighting`` lights these views; None: the renderer's own lighting does.
        """
        size = (camera.width * self.supersample, camera.height * self.supersample)
        drawn = self._draw(
            shaded_surface(mesh, lighting or self.lighting),
            resized(camera, *size),
            camera_to_world.detach().cpu().double().numpy(),
        )
        images = [straight_alpha(premultiplied, self.supersample) for premultiplied in drawn]
        if not images:
            return torch.zeros(0, camera.height, camera.width, 4)
        return torch.from_numpy(np.stack(images))

    @abstractmethod
    def _draw(
        self, surface: Surface, camera: PinholeCamera, poses: Float64[np.ndarray, "n 4 4"]
    ) -> Iterator[Float32[np.ndarray, "height width 4"]]:
        """Yield premultiplied RGBA at every sample, pose by pose."""


def straight_alpha(
    premultiplied: Float32[np.ndarray, "big_height big_width 4"], factor: int
) -> Float32[np.ndarray, "height width 4"]:
    """Average ``factor`` x ``factor`` premultiplied RGBA samples, then divide colour by alpha (0 where alpha is 0).

    Straight colours must not be averaged directly: the colours of empty samples would count. This uses NumPy because
    torch's threads wait for those of OpenGL's software rasteriser and lose 20 ms per image.
    """
    if factor > 1:
        height, width = premultiplied.shape[0] // factor, premultiplied.shape[1] // factor
        pixels = np.zeros((height, width, 4), dtype=np.float32)
        for row in range(factor):
            for column in range(factor):
                pixels += premultiplied[row::factor, column::factor]
        pixels /= factor * factor
    else:
        pixels = premultiplied.copy()
    alpha = pixels[..., 3:]
    pixels[..., :3] = np.where(alpha > 0.0, np.clip(pixels[..., :3] / np.maximum(alpha, 1e-8), 0.0, 1.0), 0.0)
    return pixels
