"""The meshes that are reconstructed from an object's views, and detectors trained on images of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
import trimesh

from neural_sim.field.reconstruction import reconstruct
from neural_sim.renderer.subject import Subject
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import ViewsStage
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import SubjectScene


@dataclass(frozen=True)
class ReconstructionStage(Stage[trimesh.Trimesh]):
    """The mesh of all views but the held-out ones, see :func:`reconstruct`."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "reconstruction"

    views: ViewsStage
    resolution: int

    @property
    def title(self) -> str:
        return f"reconstruction of {self.views.object}"

    def make(self, results: Results) -> trimesh.Trimesh:
        return reconstruct(self.views.fitted(results), self.resolution)

    def pack(self, value: trimesh.Trimesh) -> dict[str, Any]:
        colours = value.visual.vertex_colors  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
        parts = {"vertices": value.vertices, "faces": value.faces, "colours": colours}
        return {name: torch.from_numpy(np.array(part)) for name, part in parts.items()}

    def unpack(self, stored: Mapping[str, Any]) -> trimesh.Trimesh:
        vertices, faces, colours = (stored[name].numpy() for name in ("vertices", "faces", "colours"))
        return trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)


@dataclass(frozen=True)
class ReconstructionDetectorStage(DetectorStage):
    """A detector trained on images of reconstructed meshes at the draws, backgrounds and places of those of the fields.
    ``subjects`` are the results of ``reconstructions``, with their renderer.
    """

    reconstructions: tuple[ReconstructionStage, ...] = field(kw_only=True)
    subjects: tuple[Subject, ...] = field(kw_only=True, metadata=UNKEYED)

    def shown(self, results: Results) -> Scene:
        return SubjectScene.of(super().shown(results), self.subjects)
