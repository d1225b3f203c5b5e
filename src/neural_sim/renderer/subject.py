"""An object of which target sets and symmetry render images, by its mesh or by its field."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.base import RadianceField
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera


class Subject(Protocol):
    """An object; ``radius`` is that of its bounding sphere in metres, None if unknown."""

    @property
    def name(self) -> str: ...
    @property
    def radius(self) -> float | None: ...

    def render(
        self, camera: PinholeCamera, camera_to_world: Float[Tensor, "n 4 4"], lighting: Lighting | None = None
    ) -> Float[Tensor, "n h w 4"]:
        """RGBA in [0, 1] with straight alpha, float32 on the CPU; colour is 0 where alpha is.

        Raises:
            ValueError: an object that cannot be rendered, or not under this lighting.
        """
        ...


@dataclass(frozen=True)
class MeshSubject:
    """A mesh, under the renderer's default light or any other."""

    item: ObjectMesh
    renderer: MeshRenderer
    radius: float | None = None

    @property
    def name(self) -> str:
        return self.item.name

    def render(
        self, camera: PinholeCamera, camera_to_world: Float[Tensor, "n 4 4"], lighting: Lighting | None = None
    ) -> Float[Tensor, "n h w 4"]:
        return self.renderer.render(self.item.mesh, camera, camera_to_world, lighting)


@dataclass(frozen=True)
class FieldSubject:
    """A field, under the light of its views; ``field`` is None for targets that render no object."""

    name: str
    field: RadianceField | None = None
    radius: float | None = None
    renderer: NerfRenderer = dataclasses.field(default_factory=NerfRenderer)

    def render(
        self, camera: PinholeCamera, camera_to_world: Float[Tensor, "n 4 4"], lighting: Lighting | None = None
    ) -> Float[Tensor, "n h w 4"]:
        if self.field is None:
            raise ValueError(f"{self.name}: nothing to render, since this target asked for no field")
        if lighting is not None:
            raise ValueError(f"{self.name}: a field of photographs can be rendered under their light alone")
        like = next(self.field.parameters())
        rgb, opacity = self.renderer.render(self.field, camera, camera_to_world.to(like))
        colour = torch.where(opacity[..., None] > 0.0, rgb / opacity[..., None].clamp_min(1e-6), 0.0)
        return torch.cat([colour.clamp(0.0, 1.0), opacity[..., None].clamp(0.0, 1.0)], -1).float().cpu()
