"""What the mesh renderers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import trimesh
from jaxtyping import Float
from torch import Tensor

from neural_sim.renderer.lighting import Lighting
from neural_sim.types import PinholeCamera


class MeshRenderer(ABC):
    """Each pixel averages ``supersample``^2 samples. Raises ``ValueError`` for a ``supersample`` below 1."""

    name: ClassVar[str]

    def __init__(self, supersample: int = 2, lighting: Lighting | None = None) -> None:
        if supersample < 1:
            raise ValueError(f"renderer.supersample: want at least 1, got {supersample}")
        self.supersample = supersample
        self.lighting = Lighting() if lighting is None else lighting

    @abstractmethod
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
