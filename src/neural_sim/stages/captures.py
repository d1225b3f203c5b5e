"""The objects of a run as photographs: their views, and their fields in the place of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.base import RadianceField
from neural_sim.objects.photos import Photos
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.renderer.subject import FieldSubject, Subject, Unseen
from neural_sim.stages.views import ViewsStage
from neural_sim.types import PosedViews


@dataclass(frozen=True)
class Captures:
    """The objects of ``source`` by name; see :class:`~neural_sim.stages.meshes.Meshes`."""

    source: Photos

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.source.names())

    @cached_property
    def digests(self) -> dict[str, str]:
        return self.source.digests()

    @cached_property
    def radii(self) -> dict[str, float | None]:
        """Of the objects, in metres, where somebody said their size."""
        return {name: self.source.radius(name) for name in self.names}

    def subject(self, name: str, field: RadianceField | None = None) -> Subject:
        """An object as target sets see it: its field, or its name alone for targets that render nothing."""
        if field is None:
            return Unseen(name, self.radii[name])
        renderer = NerfWRenderer() if isinstance(field, AppearanceField) else NerfRenderer()
        return FieldSubject(name, field, self.radii[name], renderer)


@dataclass(frozen=True)
class PhotoViewsStage(ViewsStage):
    """Photographs of one object, ``content`` the digest of their files, as views of one camera. Of ``settings`` the
    counts and the image size apply."""

    @property
    def held_out(self) -> int:
        return len(self._source.split(self.object, self.settings.count, self.settings.held_out)[1])

    @property
    def _source(self) -> Photos:
        if not isinstance(self.objects, Captures):
            raise TypeError(f"PhotoViewsStage: want Captures, got {type(self.objects).__name__}")
        return self.objects.source

    def make(self, results: object) -> PosedViews:
        wanted = self.settings
        return self._source.views(self.object, wanted.count, wanted.held_out, wanted.image_size)
