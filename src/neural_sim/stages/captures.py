"""The objects of a run as photographs: their views, and fields in the place of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.objects.photos import Photos, PoseCorrector
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.renderer.subject import FieldSubject
from neural_sim.stages.masks import MasksStage
from neural_sim.stages.meshes import Objects
from neural_sim.stages.stage import Results
from neural_sim.stages.views import ViewsStage
from neural_sim.types import PosedViews


@dataclass(frozen=True)
class Captures(Objects):
    """Objects of photographs."""

    source: Photos

    @cached_property
    def radii(self) -> dict[str, float | None]:
        """``objects.size``, halved."""
        return {name: self.source.radius(name) for name in self.names}

    def subject(self, name: str, field: RadianceField | None = None) -> FieldSubject:
        """The object by its field; without one, for targets that render no object, it cannot be rendered."""
        renderer = NerfWRenderer() if isinstance(field, AppearanceField) else NerfRenderer()
        return FieldSubject(name, field, self.radii[name], renderer)


@dataclass(frozen=True)
class PhotoViewsStage(ViewsStage):
    """Photographs of one object as views of one camera. ``content`` is the digest of their files; of ``settings`` only
    the counts and the image size apply. ``masks`` computes the object's masks, None: photographs bring them; ``poses``
    is the source's.
    """

    masks: MasksStage | None = None
    poses: PoseCorrector | None = None

    @property
    def held_out(self) -> int:
        return len(self._source.split(self.object, self.settings.count, self.settings.held_out)[1])

    @property
    def _source(self) -> Photos:
        if not isinstance(self.objects, Captures):
            raise TypeError(f"PhotoViewsStage: want Captures, got {type(self.objects).__name__}")
        return self.objects.source

    def make(self, results: Results) -> PosedViews:
        counts = self.settings
        computed = () if self.masks is None else results(self.masks)
        pictures = self._source.pictures(self.object, computed)
        return self._source.views(self.object, counts.count, counts.held_out, counts.image_size, pictures)
