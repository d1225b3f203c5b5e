"""Stage ``pool``: renders of all bins, shared by everything in a run that reads or composes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from neural_sim.outer.inner import RenderedPool
from neural_sim.randomness import stream
from neural_sim.stages.scene import SceneStage
from neural_sim.stages.stage import Results, Stage


@dataclass(frozen=True)
class PoolStage(Stage[RenderedPool]):
    """``per_bin`` renders of every bin of every object in ``scene``, drawn with the random numbers of the psi loop.

    The pool stays in memory, so that label shift and the psi loop share it if they need the same one.
    """

    phase: ClassVar[str] = "psi"
    kind: ClassVar[str] = "pool"
    stored: ClassVar[bool] = False

    scene: SceneStage
    per_bin: int
    seed: int

    @property
    @override
    def title(self) -> str:
        return "renders of all bins"

    @override
    def make(self, results: Results) -> RenderedPool:
        scene = results(self.scene)
        lights = scene.distribution.lights > 0
        return RenderedPool.of(scene, self.per_bin, stream(self.seed, "psi"), lights=lights)
