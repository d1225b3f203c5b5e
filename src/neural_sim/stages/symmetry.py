"""Stage ``symmetry``: which bins of an angle look the same because an object is symmetric."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.stages.field import FieldStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.views import Objects
from neural_sim.target.symmetry import equivalent_bins
from neural_sim.types import PinholeCamera


@dataclass(frozen=True)
class SymmetryStage(Stage[list[list[int]]]):
    """Groups of bins, numbered from 1, in which an object looks the same.

    ``content`` is the digest of the object; ``fields`` contains its field if it has no mesh.
    """

    phase: ClassVar[str] = "report"
    kind: ClassVar[str] = "symmetry"

    object: str
    content: str
    angle: str
    distribution: SceneDistribution
    camera: PinholeCamera
    fields: tuple[FieldStage, ...]
    objects: Objects = field(metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"symmetry of {self.object}"

    @override
    def make(self, results: Results) -> list[list[int]]:
        item = self.objects.subject(self.object, *(results(stage).field for stage in self.fields))
        groups = equivalent_bins(item, self.distribution, self.angle, self.camera)
        return [[b + 1 for b in group] for group in groups]
