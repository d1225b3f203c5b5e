"""An object as target sets and symmetry see it: a name, a size, and images of it, whether of a mesh or of a field."""

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
    """``radius`` is that of the object's sphere in metres, None where nobody knows it."""

    @property
    def name(self) -> str: ...
    @property
    def radius(self) -> float | None: ...

    def render(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        """RGBA in [0, 1] with straight alpha, float32 on the CPU; colour is 0 where alpha is.

        Raises ``ValueError`` for a light that this object cannot be seen under.
        """
        ...


@dataclass(frozen=True)
class MeshSubject:
    """A mesh, under the renderer's own light or any other."""

    item: ObjectMesh
    renderer: MeshRenderer
    radius: float | None = None

    @property
    def name(self) -> str:
        return self.item.name

    def render(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        return self.renderer.render(self.item.mesh, camera, camera_to_world, lighting)


@dataclass(frozen=True)
class Unseen:
    """An object by its name, for targets that render none."""

    name: str
    radius: float | None = None

    def render(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        raise ValueError(f"{self.name}: there is nothing to render here, its field is not asked for")


@dataclass(frozen=True)
class FieldSubject:
    """A field of an object that there is no mesh of, under the light that its views saw."""

    name: str
    field: RadianceField
    radius: float | None = None
    renderer: NerfRenderer = dataclasses.field(default_factory=NerfRenderer)

    def render(
        self,
        camera: PinholeCamera,
        camera_to_world: Float[Tensor, "n 4 4"],
        lighting: Lighting | None = None,
    ) -> Float[Tensor, "n h w 4"]:
        if lighting is not None:
            raise ValueError(
                f"{self.name}: a field of photographs is seen under their light alone, not another"
            )
        own = next(self.field.parameters())
        rgb, opacity = self.renderer.render(self.field, camera, camera_to_world.to(own))
        colour = torch.where(opacity[..., None] > 0.0, rgb / opacity[..., None].clamp_min(1e-6), 0.0)
        return torch.cat([colour.clamp(0.0, 1.0), opacity[..., None].clamp(0.0, 1.0)], -1).float().cpu()
