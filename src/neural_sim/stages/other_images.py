"""Detectors trained on images that do not come from the fields: of meshes, of the fields' own views, or of another
program.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.stage import UNKEYED, Results
from neural_sim.stages.views import Objects, ViewsStage
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.pictures import PictureScene
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import SubjectScene
from neural_sim.target.coco import CocoTarget


@dataclass(frozen=True)
class MeshDetectorStage(DetectorStage):
    """A detector trained on images of the objects' meshes at the draws, backgrounds and places of those of the fields.

    ``contents`` are the digests of the meshes by name, ``supersample`` is that of their renderer.
    """

    contents: Mapping[str, str] = field(kw_only=True)
    supersample: int = field(kw_only=True)
    objects: Objects = field(kw_only=True, metadata=UNKEYED)

    def shown(self, results: Results) -> Scene:
        subjects = tuple(self.objects.subject(name) for name in self.names)
        return SubjectScene.of(super().shown(results), subjects)


@dataclass(frozen=True)
class ViewsDetectorStage(DetectorStage):
    """A detector trained on the views that the fields are fitted to, on the same backgrounds as images of the fields
    (the paper's "images to train NeRF", Sec. 4.4 and Table 2); psi has no part in them.
    """

    views: tuple[ViewsStage, ...] = field(kw_only=True)

    def shown(self, results: Results) -> Scene:
        return PictureScene.of(super().shown(results), [views.fitted(results) for views in self.views])


@dataclass(frozen=True)
class CocoDetectorStage(DetectorStage):
    """A detector trained on all images of a COCO file, resized to the camera's size; psi has no part in them."""

    source: CocoTarget = field(kw_only=True)

    def images(self, results: Results, generator: torch.Generator | None = None) -> RenderedImages:
        loaded = self.source.load(self.names, self.camera.height, self.camera.width)
        return RenderedImages(loaded.to(self.device), (), (), ())


def trained_on(stage: DetectorStage, kind: type[DetectorStage], **more: Any) -> DetectorStage:
    """A stage of another ``kind`` with the settings of ``stage``, and those that only this kind has."""
    settings = {f.name: getattr(stage, f.name) for f in dataclasses.fields(DetectorStage)}
    return kind(**settings, **more)
