"""The objects of a run, and their kind that has meshes: loaded when a stage first renders one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, Protocol

from neural_sim.field.base import RadianceField
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.subject import MeshSubject, Subject
from neural_sim.renderer.views import choose_mesh_renderer


class Source(Protocol):
    """A source of objects, such as a folder."""

    def names(self) -> list[str]: ...

    def digests(self) -> dict[str, str]:
        """SHA-256 of each object's content, by name."""
        ...


class ObjectSource(Source, Protocol):
    """A source of meshes; ``metric``: they are in metres, otherwise they have no unit of length."""

    metric: ClassVar[bool]

    def load(self) -> list[ObjectMesh]: ...


@dataclass(frozen=True)
class Objects(ABC):
    """The objects of a run by name, of meshes or of photographs. ``radii`` are in metres, None if unknown."""

    source: Source

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.source.names())

    @cached_property
    def digests(self) -> dict[str, str]:
        return self.source.digests()

    @cached_property
    @abstractmethod
    def radii(self) -> dict[str, float | None]: ...

    @abstractmethod
    def subject(self, name: str, field: RadianceField | None = None) -> Subject:
        """The object as target sets render it; ``field`` is its radiance field where there is one."""


@dataclass(frozen=True)
class Meshes(Objects):
    """Objects of meshes, and their renderer."""

    source: ObjectSource
    backend: Literal["auto", "pyrender", "raycast"] = "auto"
    supersample: int = 2

    @cached_property
    def items(self) -> dict[str, ObjectMesh]:
        return {item.name: item for item in self.source.load()}

    @cached_property
    def radii(self) -> dict[str, float | None]:
        return {name: item.radius if self.source.metric else None for name, item in self.items.items()}

    def subject(self, name: str, field: RadianceField | None = None) -> MeshSubject:
        """The object by its mesh, with or without a field."""
        return MeshSubject(self.items[name], self.renderer, self.radii[name])

    @cached_property
    def renderer(self) -> MeshRenderer:
        return choose_mesh_renderer(self.backend, self.supersample)
