"""What the mesh renderers share."""

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
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.supersampling import straight_alpha
from neural_sim.renderer.surface import Surface, shaded_surface
from neural_sim.types import PinholeCamera


class MeshRenderer(ABC):
    """Each pixel averages ``supersample``^2 samples. Raises ``ValueError`` for a ``supersample`` below 1."""

    name: ClassVar[str]

    def __init__(self, supersample: int = 2, lighting: Lighting | None = None) -> None:
        if supersample < 1:
            raise ValueError(f"renderer.supersample: want at least 1, got {supersample}")
        self.supersample = supersample
        self.lighting = Lighting() if lighting is None else lighting

    def render(
        self,
        mesh: trimesh.Trimesh,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        """RGBA in [0, 1] with straight alpha, float32 on the CPU; colour is 0 where alpha is.

        ``lighting`` is that of these views; None: the renderer's own.
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
        """Premultiplied RGBA at every sample, pose by pose."""
