"""Stage ``views``: the posed views of an object that train its field."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch

from neural_sim.renderer.views import Views
from neural_sim.stages.meshes import Meshes, Objects
from neural_sim.stages.pixels import from_bytes, to_bytes
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.types import PinholeCamera, PosedViews


@dataclass(frozen=True)
class ViewsStage(Stage[PosedViews]):
    """Views of one object; ``content`` is the digest of its mesh. Not the run's seed, so that runs share them."""

    phase: ClassVar[str] = "views"
    kind: ClassVar[str] = "views"
    keep: ClassVar[bool] = False  # large, read once

    object: str
    content: str
    settings: Views
    objects: Objects = field(metadata=UNKEYED)

    @property
    def title(self) -> str:
        return f"views of {self.object}"

    @property
    def held_out(self) -> int:
        """How many of the views, the last, only score the field."""
        return self.settings.held_out

    def fitted(self, results: Results) -> PosedViews:
        """The views that a field is fitted to, without those held out."""
        views = results(self)
        return views.select(torch.arange(len(views) - self.held_out))

    def make(self, results: Results) -> PosedViews:
        if not isinstance(self.objects, Meshes):
            raise TypeError(f"ViewsStage: want Meshes, got {type(self.objects).__name__}")
        return self.settings.render(self.objects.renderer, self.objects.items[self.object])

    def pack(self, value: PosedViews) -> dict[str, Any]:
        camera, weights = value.camera, value.light_weights
        return {
            "images": to_bytes(value.images),
            "camera_to_world": value.camera_to_world.cpu(),
            "camera": list(dataclasses.astuple(camera)),
            "light_weights": None if weights is None else weights.cpu(),
            "known": None if value.known is None else value.known.cpu(),
        }

    def unpack(self, stored: Mapping[str, Any]) -> PosedViews:
        camera = PinholeCamera(*stored["camera"])
        images = from_bytes(stored["images"])
        return PosedViews(images, stored["camera_to_world"], camera, stored["light_weights"], stored["known"])
