"""Stage ``target_sets``: labelled target images for validation, for scores, and for training."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.stages.field import FieldStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.store import from_bytes, to_bytes
from neural_sim.stages.views import Objects
from neural_sim.synthesis.synthesizer import Synthesizer, unshown
from neural_sim.target.base import Target
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TargetSets:
    """Disjoint parts of the target's labelled images.

    Psi is learned on ``val``, final scores are measured on ``test``, and detectors are trained on ``train`` if
    ``training.real`` asks for it (None: no such part).
    """

    val: LabelledImages
    test: LabelledImages
    train: LabelledImages | None = None


@dataclass(frozen=True)
class TargetSetsStage(Stage[TargetSets]):
    """The image sets of the configured target.

    ``contents`` are the digests of the objects by name; ``fields`` replace meshes if the target renders objects that
    have none.
    """

    phase: ClassVar[str] = "target_sets"
    kind: ClassVar[str] = "target"

    target: Target
    contents: Mapping[str, str]
    distribution: SceneDistribution
    synthesizer: Synthesizer
    camera: PinholeCamera
    rig: LightRig | None
    seed: int
    fields: tuple[FieldStage, ...]
    objects: Objects = field(metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return "target sets"

    @property
    @override
    def early(self) -> bool:
        return not self.target.renders  # so that unusable photographs are refused at once

    @override
    def check(self) -> None:
        if self.target.renders:
            self.synthesizer.count.check(len(self.objects.names))

    @override
    def make(self, results: Results) -> TargetSets:
        fields = {stage.views.object: results(stage).field for stage in self.fields}
        objects = {
            name: self.objects.subject(name, fields.get(name), rig=self.rig) for name in self.objects.names
        }
        how = self.distribution, self.camera, self.synthesizer, self.seed
        return TargetSets(**self.target.sets(objects, *how))

    @override
    def pack(self, value: TargetSets) -> dict[str, dict[str, Tensor]]:
        parts = {part.name: getattr(value, part.name) for part in fields(TargetSets)}
        return {name: _packed(images) for name, images in parts.items() if images is not None}

    @override
    def unpack(self, stored: Mapping[str, Mapping[str, Tensor]]) -> TargetSets:
        sets = TargetSets(**{part: _unpacked(images) for part, images in stored.items()})
        unseen = unshown(sets.test, self.objects.names)
        if unseen:
            _log.warning(
                "target: no test image shows %s: scores cover the other objects only; want test images that show it, "
                "or objects.names without it", ", ".join(unseen),
            )  # fmt: skip
        return sets


def _packed(images: LabelledImages) -> dict[str, Tensor]:
    tensors = {field.name: getattr(images, field.name).cpu() for field in fields(LabelledImages)}
    return tensors | {"images": to_bytes(images.images)}


def _unpacked(stored: Mapping[str, Tensor]) -> LabelledImages:
    return LabelledImages(**{**stored, "images": from_bytes(stored["images"])})
