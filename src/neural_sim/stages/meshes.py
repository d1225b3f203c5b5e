"""The objects of a run as meshes, loaded when a stage first draws one, and what draws them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

from neural_sim.field.base import RadianceField
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.subject import MeshSubject, Subject
from neural_sim.renderer.views import choose_mesh_renderer


class ObjectSource(Protocol):
    """Where objects come from, such as a folder of meshes."""

    def names(self) -> list[str]: ...

    def digests(self) -> dict[str, str]:
        """SHA-256 of each object's geometry and texture, by name."""
        ...

    def load(self) -> list[ObjectMesh]: ...


class Objects(Protocol):
    """The objects of a run by name, of meshes or of photographs. ``radii`` are in metres, None where unknown."""

    @cached_property
    def names(self) -> tuple[str, ...]: ...
    @cached_property
    def digests(self) -> dict[str, str]: ...
    @cached_property
    def radii(self) -> dict[str, float | None]: ...
    def subject(self, name: str, field: RadianceField | None = None) -> Subject: ...


@dataclass(frozen=True)
class Meshes:
    """The objects of ``source`` by name, and a mesh renderer."""

    source: ObjectSource
    backend: Literal["auto", "pyrender", "raycast"] = "auto"
    supersample: int = 2

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.source.names())

    @cached_property
    def digests(self) -> dict[str, str]:
        return self.source.digests()

    @cached_property
    def items(self) -> dict[str, ObjectMesh]:
        return {item.name: item for item in self.source.load()}

    @cached_property
    def radii(self) -> dict[str, float | None]:
        """Of the objects, in metres; None of objects whose source knows no unit (``metric`` is False)."""
        known = getattr(self.source, "metric", True)
        return {name: item.radius if known else None for name, item in self.items.items()}

    def subject(self, name: str, field: RadianceField | None = None) -> Subject:
        """An object as target sets see it: its mesh, whatever its field."""
        return MeshSubject(self.items[name], self.renderer, self.radii[name])

    @cached_property
    def renderer(self) -> MeshRenderer:
        return choose_mesh_renderer(self.backend, self.supersample)
