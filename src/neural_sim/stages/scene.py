"""The fields of all objects, with the renderer and synthesizer of their images; assembled in memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.stages.field import FieldStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import PinholeCamera


@dataclass(frozen=True)
class SceneStage(Stage[Scene]):
    """What training images are synthesised from.

    The key covers ``drawn``, what draws of given probabilities depend on, and not ``distribution``: methods that relax
    draws differently use the same results of hard draws. ``radii`` are the objects' in metres, None where distances are
    in radii.
    """

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "scene"
    stored: ClassVar[bool] = False

    names: tuple[str, ...]
    fields: tuple[FieldStage, ...]
    renderer: NerfRenderer
    camera: PinholeCamera
    synthesizer: Synthesizer
    drawn: Any
    radii: tuple[float, ...] | None
    distribution: SceneDistribution = field(metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return "scene of all objects"

    @override
    def make(self, results: Results) -> Scene:
        fields = tuple(results(stage).field for stage in self.fields)
        return Scene(
            self.names, fields, self.renderer, self.camera, self.synthesizer, self.distribution, radii=self.radii
        )  # fmt: skip
