"""Stages of meshes reconstructed from the views of objects, and of scene subjects that show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
import trimesh
from typing_extensions import override

from neural_sim.field.reconstruction import reconstruct
from neural_sim.renderer.base import MeshRenderer
from neural_sim.stages.scene import SubjectStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import ViewsStage
from neural_sim.synthesis.subjects import MeshSubject


@dataclass(frozen=True)
class ReconstructionStage(Stage[trimesh.Trimesh]):
    """The mesh reconstructed from all views except held-out ones, see ``reconstruct``."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "reconstruction"

    views: ViewsStage
    resolution: int

    @property
    @override
    def title(self) -> str:
        return f"reconstruction of {self.views.object}"

    @override
    def make(self, results: Results) -> trimesh.Trimesh:
        return reconstruct(self.views.fitted(results), self.resolution)

    @override
    def pack(self, value: trimesh.Trimesh) -> dict[str, Any]:
        colours = value.visual.vertex_colors  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
        parts = {"vertices": value.vertices, "faces": value.faces, "colours": colours}
        return {name: torch.from_numpy(np.array(part)) for name, part in parts.items()}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> trimesh.Trimesh:
        vertices, faces, colours = (stored[name].numpy() for name in ("vertices", "faces", "colours"))
        return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


@dataclass(frozen=True)
class ReconstructionSubjectStage(SubjectStage[MeshSubject]):
    """An object shown by its reconstructed mesh; ``radius`` is in metres, None if distances are in radii."""

    reconstruction: ReconstructionStage
    radius: float | None
    renderer: MeshRenderer = field(metadata=UNKEYED)

    @property
    @override
    def object(self) -> str:
        return self.reconstruction.views.object

    @override
    def make(self, results: Results) -> MeshSubject:
        return MeshSubject(self.object, results(self.reconstruction), self.renderer, radius=self.radius)
