"""The objects of a run, from meshes or photographs, and stage ``views`` with the views that fields are fitted to."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d
from typing_extensions import override

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.field.quality import Placed
from neural_sim.objects.mesh import MeshSource, ObjectMesh, Source
from neural_sim.objects.photos import Photos, PoseCorrector
from neural_sim.objects.placing import upright
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.views import Backend, Views, choose_mesh_renderer
from neural_sim.stages.cameras import CommandMasksStage, MasksOfFrames, MasksStage, command_masks
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.store import from_bytes, to_bytes
from neural_sim.synthesis.subjects import MeshSubject, PhotographedField, RenderedSubject
from neural_sim.types import PinholeCamera, PosedViews

PHOTOGRAPH = 320
"""Approximate longer side, in pixels, of photographs on a page."""
DIMMED = 0.25
"""Brightness of the background in photographs on a page."""


@dataclass(frozen=True)
class ViewsStage(Stage[PosedViews]):
    """Views of one object. They do not depend on the run's seed, so runs with different seeds share views and fields.

    Args:
        object: name of the object.
        content: digest of its mesh, or of the files and options of its capture.
        settings: settings of the views; for photographs, only the counts and the image size apply.
        objects: all objects of the run.
        masks: masks of photographs, if they are computed.
        refinement: refinement of the poses of photographs.
    """

    phase: ClassVar[str] = "views"
    kind: ClassVar[str] = "views"
    keep: ClassVar[bool] = False  # large, read once

    object: str
    content: str
    settings: Views
    objects: Objects = field(metadata=UNKEYED)
    masks: MasksStage | CommandMasksStage | None = None
    refinement: PoseCorrector | None = None

    @property
    @override
    def title(self) -> str:
        return f"views of {self.object}"

    @property
    def held_out(self) -> int:
        """Number of held-out views, which come last and only serve to score the field."""
        return self.objects.held_out(self.object, self.settings)

    def fitted(self, results: Results) -> PosedViews:
        """Return the views that a field is fitted to, without held-out ones."""
        views = results(self)
        return views.select(torch.arange(len(views) - self.held_out))

    @override
    def make(self, results: Results) -> PosedViews:
        masks = () if self.masks is None else results(self.masks)
        return self.objects.views(self.object, self.settings, masks)

    @override
    def pack(self, value: PosedViews) -> dict[str, Any]:
        camera, weights = value.camera, value.light_weights
        return {
            "images": to_bytes(value.images),
            "camera_to_world": value.camera_to_world.cpu(),
            "camera": list(dataclasses.astuple(camera)),
            "light_weights": None if weights is None else weights.cpu(),
            "known": None if value.known is None else value.known.cpu(),
        }

    @override
    def unpack(self, stored: Mapping[str, Any]) -> PosedViews:
        camera = PinholeCamera(*stored["camera"])
        images = from_bytes(stored["images"])
        return PosedViews(images, stored["camera_to_world"], camera, stored["light_weights"], stored["known"])


@dataclass(frozen=True)
class Objects(ABC):
    """The objects of a run by name, whether they come from meshes, from photographs or from both."""

    source: Source
    has_meshes: ClassVar[bool]
    """True if every object can be rendered without its field."""

    @staticmethod
    def of(source: MeshSource | Photos, views: Views) -> Objects:
        """Return the objects of a configured source; meshes are rendered with the settings in ``views``."""
        if not isinstance(source, Photos):
            return Meshes(source, views.backend, views.supersample)
        captures = Captures(source)
        if source.beside is None:
            return captures
        return Mixed(source, captures, Meshes(source.beside, views.backend, views.supersample))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out cached properties: a process that receives the objects loads the meshes that it renders."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names, in label order."""
        return tuple(self.source.names())

    @cached_property
    def digests(self) -> dict[str, str]:
        """Digests of the objects' contents by name."""
        return self.source.digests()

    @cached_property
    @abstractmethod
    def radii(self) -> dict[str, float | None]:
        """Radii of the bounding spheres in metres by name, None if unknown."""

    @abstractmethod
    def subject(
        self, name: str, field: RadianceField | None = None, *, rig: LightRig | None = None
    ) -> RenderedSubject:
        """Return an object as target sets render it.

        Args:
            name: name of the object.
            field: its radiance field, for objects without meshes.
            rig: lights whose weights the scene may draw, for objects with meshes.
        """

    @abstractmethod
    def views(self, name: str, settings: Views, masks: MasksOfFrames = ()) -> PosedViews:
        """Return the views of an object, held-out ones last."""

    def held_out(self, name: str, settings: Views) -> int:
        """Return the number of held-out views of an object."""
        return settings.held_out

    def part(self, name: str) -> Objects:
        """Return the objects of the same kind as ``name``."""
        return self

    @property
    def refuses_poor(self) -> bool:
        """Whether training on fields that do not show their objects is refused."""
        return False

    def photographs(
        self, name: str, settings: Views, masks: MasksOfFrames, held_out: Sequence[int]
    ) -> tuple[Float[Tensor, "_ _ 3"], ...]:
        """Return the photographs of some held-out views, with dimmed backgrounds; none for objects from meshes."""
        return ()

    def placed(self, name: str, settings: Views, views: PosedViews) -> Placed | None:
        """Return the position of an object in its capture; None for objects from meshes."""
        return None

    def stage(self, name: str, settings: Views) -> ViewsStage:
        """Return the stage that makes the views of an object."""
        return ViewsStage(name, self.digests[name], settings, self)


@dataclass(frozen=True)
class Meshes(Objects):
    """Objects from meshes, which are loaded when they are first needed, and their renderer."""

    has_meshes: ClassVar[bool] = True

    source: MeshSource
    backend: Backend = "auto"
    supersample: int = 2

    @cached_property
    def items(self) -> dict[str, ObjectMesh]:
        """The meshes by name."""
        return {item.name: item for item in self.source.load()}

    @cached_property
    @override
    def radii(self) -> dict[str, float | None]:
        return {name: item.radius if self.source.metric else None for name, item in self.items.items()}

    @override
    def subject(
        self, name: str, field: RadianceField | None = None, *, rig: LightRig | None = None
    ) -> MeshSubject:
        return MeshSubject(name, self.items[name].mesh, self.renderer, rig, radius=self.radii[name])

    @override
    def views(self, name: str, settings: Views, masks: MasksOfFrames = ()) -> PosedViews:
        return settings.render(self.renderer, self.items[name])

    @cached_property
    def renderer(self) -> MeshRenderer:
        """The renderer of meshes."""
        return choose_mesh_renderer(self.backend, self.supersample)


@dataclass(frozen=True)
class Captures(Objects):
    """Objects from photographs, which are rendered from their fields."""

    has_meshes: ClassVar[bool] = False

    source: Photos

    @cached_property
    @override
    def radii(self) -> dict[str, float | None]:
        return {name: self.source.radius(name) for name in self.names}

    @override
    def subject(
        self, name: str, field: RadianceField | None = None, *, rig: LightRig | None = None
    ) -> PhotographedField:
        renderer = NerfWRenderer() if isinstance(field, AppearanceField) else NerfRenderer()
        return PhotographedField(name, field, renderer, radius=self.radii[name])

    @override
    def views(self, name: str, settings: Views, masks: MasksOfFrames = ()) -> PosedViews:
        pictures = self.source.pictures(name, masks)
        return self.source.views(name, settings.count, settings.held_out, settings.image_size, pictures)

    @property
    @override
    def refuses_poor(self) -> bool:
        return self.source.poor == "refuse"

    @override
    def photographs(
        self, name: str, settings: Views, masks: MasksOfFrames, held_out: Sequence[int]
    ) -> tuple[Float[Tensor, "_ _ 3"], ...]:
        test = self.source.split(name, settings.count, settings.held_out)[1]
        pictures = self.source.pictures(name, masks)
        return tuple(dimmed(pictures.rgba(test[number])) for number in held_out)

    @override
    def placed(self, name: str, settings: Views, views: PosedViews) -> Placed:
        frames = [
            frame for part in self.source.split(name, settings.count, settings.held_out) for frame in part
        ]
        own = views.camera_to_world.double().numpy()
        given = np.stack([frame.camera_to_world for frame in frames])
        # A similarity takes the capture's frame to the object's: its scale and centre follow from the camera positions.
        turn = upright(np.array(self.source.up_of(name)), name)
        apart = [np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0)) for poses in (given, own)]
        radius = float(apart[0] / apart[1])
        centre = (given[:, :3, 3] - radius * own[:, :3, 3] @ turn).mean(0)
        distance = np.linalg.norm(own[:, :3, 3], axis=1)
        return Placed(_three(centre), radius, (float(distance.min()), float(distance.max())))

    @override
    def held_out(self, name: str, settings: Views) -> int:
        return len(self.source.split(name, settings.count, settings.held_out)[1])

    @override
    def stage(self, name: str, settings: Views) -> ViewsStage:
        content, source = self.digests[name], self.source
        masks = command_masks(source, name)
        if source.masks == "scene" and source.scene is not None:
            masks = MasksStage(name, content, source.scene, source)
        return ViewsStage(name, content, settings, self, masks, source.refinement)


@dataclass(frozen=True)
class Mixed(Objects):
    """Objects from photographs followed by objects from meshes, as classes of one detector."""

    has_meshes: ClassVar[bool] = False

    source: Photos
    captures: Captures
    meshes: Meshes

    @override
    def part(self, name: str) -> Objects:
        return self.captures if name in self.captures.names else self.meshes

    @cached_property
    @override
    def names(self) -> tuple[str, ...]:
        return *self.captures.names, *self.meshes.names

    @cached_property
    @override
    def digests(self) -> dict[str, str]:
        return {**self.captures.digests, **self.meshes.digests}

    @cached_property
    @override
    def radii(self) -> dict[str, float | None]:
        return {**self.captures.radii, **self.meshes.radii}

    @override
    def subject(
        self, name: str, field: RadianceField | None = None, *, rig: LightRig | None = None
    ) -> RenderedSubject:
        return self.part(name).subject(name, field, rig=rig)

    @override
    def views(self, name: str, settings: Views, masks: MasksOfFrames = ()) -> PosedViews:
        return self.part(name).views(name, settings, masks)

    @override
    def stage(self, name: str, settings: Views) -> ViewsStage:
        return self.part(name).stage(name, settings)


def dimmed(rgba: Float[Tensor, "h w 4"]) -> Float[Tensor, "_ _ 3"]:
    """Return a photograph at reduced size with its background dimmed."""
    pixels = rgba.movedim(-1, 0)[None]
    pixels = avg_pool2d(pixels, max(1, round(max(pixels.shape[2:]) / PHOTOGRAPH)))[0].movedim(0, -1)
    return pixels[..., :3] * (DIMMED + (1.0 - DIMMED) * pixels[..., 3:])


def _three(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z
