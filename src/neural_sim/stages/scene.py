"""Scenes and their subjects, assembled in memory from fields, meshes or views; and images made by other programs."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.stages.field import FieldStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import Objects, ViewsStage
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.pictures import PictureSubject
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject, RenderedSubject, Subject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.coco import CocoTarget
from neural_sim.types import LabelledImages, PinholeCamera

SubjectT = TypeVar("SubjectT", bound=Subject)


class SubjectStage(Stage[SubjectT]):
    """One object of a scene."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "subject"
    stored: ClassVar[bool] = False

    @property
    @abstractmethod
    def object(self) -> str:
        """Name of the object."""

    @property
    def title(self) -> str:
        """Description of the result."""
        return f"{self.object} in a scene"


@dataclass(frozen=True)
class FieldSubjectStage(SubjectStage[FieldSubject]):
    """An object shown by its field; ``radius`` is in metres, None if distances are in radii."""

    field: FieldStage
    renderer: NerfRenderer
    radius: float | None

    @property
    @override
    def object(self) -> str:
        return self.field.views.object

    @override
    def make(self, results: Results) -> FieldSubject:
        return FieldSubject(self.object, self.field.usable(results), self.renderer, radius=self.radius)


@dataclass(frozen=True)
class MeshSubjectStage(SubjectStage[RenderedSubject]):
    """The object ``item`` shown by its mesh, whose digest is ``content``, under one fixed light."""

    item: str
    content: str
    supersample: int
    objects: Objects = field(metadata=UNKEYED)

    @property
    @override
    def object(self) -> str:
        return self.item

    @override
    def make(self, results: Results) -> RenderedSubject:
        return self.objects.subject(self.item)


@dataclass(frozen=True)
class PictureSubjectStage(SubjectStage[PictureSubject]):
    """An object shown by the views that its field is fitted to (the paper's "images to train NeRF", Sec. 4.4, Table 2).

    ``camera`` takes the images of the scene; ``radius`` is in the unit of the scene's distances.
    """

    views: ViewsStage
    camera: PinholeCamera
    radius: float
    device: torch.device = field(metadata=UNKEYED)

    @property
    @override
    def object(self) -> str:
        return self.views.object

    @override
    def make(self, results: Results) -> PictureSubject:
        views = self.views.fitted(results).to(self.device)
        return PictureSubject.of(self.object, views, self.camera, self.radius)


class TrainingImages(Protocol):
    """A source of training images: a ``Scene``, or ``LoadedImages``."""

    def training_set(
        self, psi: Float[Tensor, "objects K"], count: int, generator: torch.Generator
    ) -> RenderedImages:
        """Return labelled images, ``count`` per object if they are drawn from p_psi."""
        ...


class TrainingImagesStage(Stage[Any]):
    """A stage whose result is a source of training images (``TrainingImages``)."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "scene"
    stored: ClassVar[bool] = False

    camera: PinholeCamera

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of their class labels."""


@dataclass(frozen=True)
class SceneStage(TrainingImagesStage):
    """The scene of ``subjects``.

    The key covers ``drawn``, the settings that draws from given probabilities depend on, instead of ``distribution``,
    so that methods that relax draws differently share results of hard draws.
    """

    subjects: tuple[SubjectStage[Any], ...]
    camera: PinholeCamera
    synthesizer: Synthesizer
    drawn: Any
    distribution: SceneDistribution = field(metadata=UNKEYED)

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(subject.object for subject in self.subjects)

    @property
    @override
    def title(self) -> str:
        return "scene of all objects"

    def showing(self, subjects: tuple[SubjectStage[Any], ...]) -> SceneStage:
        """Return the scene with other subjects, but the same draws, backgrounds and positions."""
        return replace(self, subjects=subjects)

    @override
    def check(self) -> None:
        self.synthesizer.count.check(len(self.subjects))

    @override
    def make(self, results: Results) -> Scene:
        subjects = tuple(results(subject) for subject in self.subjects)
        return Scene(subjects, self.camera, self.synthesizer, self.distribution)


@dataclass(frozen=True)
class LoadedImages:
    """Images made by another program, independently of psi."""

    images: LabelledImages

    def training_set(
        self, psi: Float[Tensor, "objects K"], count: int, generator: torch.Generator
    ) -> RenderedImages:
        """Return all images."""
        return RenderedImages(self.images, (), (), ())


@dataclass(frozen=True)
class LoadedImagesStage(TrainingImagesStage):
    """All images of a COCO file, resized to the image size of the camera."""

    source: CocoTarget
    class_names: tuple[str, ...]
    camera: PinholeCamera

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return self.class_names

    @property
    @override
    def title(self) -> str:
        return "images of another program"

    @override
    def make(self, results: Results) -> LoadedImages:
        return LoadedImages(self.source.load(self.names, self.camera.height, self.camera.width))
