"""A run as it was asked for, and the account of what it cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neural_sim.baseline.base import Fixed, HypergradientLoop, RewardMethod
from neural_sim.detector.retinanet import Detector
from neural_sim.field.recipe import FieldRecipe
from neural_sim.gradient.estimators import Estimator
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.settings import Outer, Training, Views
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.store import Entry
from neural_sim.synthesis.scene import HARD, Draws, HardDraws
from neural_sim.synthesis.training_set import Synthesizer


@dataclass(frozen=True)
class Experiment:
    """All parts of a run, built and validated; ``config`` is what they were built from, for keys and reports."""

    name: str
    seed: int
    score_at: tuple[float, ...]
    stages: tuple[str, ...]
    store: Path
    mlflow: str
    progress: bool
    accelerator: str
    objects: Any
    views: Views
    field: FieldRecipe
    renderer: NerfRenderer
    distribution: SceneDistribution
    synthesis: Synthesizer
    target: Any
    detector: Callable[..., Detector]
    training: Training
    outer: Outer
    solver: AdjointSolver
    gradient: Estimator
    baseline: Fixed | HypergradientLoop | RewardMethod
    config: dict[str, Any]

    @property
    def draws(self) -> Draws:
        """How the method wants its images drawn: as its estimator does, or as a method that sees rewards says."""
        if isinstance(self.baseline, HypergradientLoop):
            return self.gradient.draws
        return HARD if isinstance(self.baseline, Fixed) else HardDraws(explore=self.baseline.explores)


@dataclass(frozen=True)
class Omission:
    """Work that a run does not do, and why. ``share`` is the part of that kind of work, ``seconds`` what it would
    take, where they are known."""

    stage: str
    what: str
    why: str
    share: float | None = None
    seconds: float | None = None


@dataclass
class Account:
    """What a run cost and what it did not have to do."""

    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[Omission] = field(default_factory=list)

    def note(self, stage: str, entry: Entry, what: str) -> None:
        """Count a result that the store had."""
        if entry.found:
            self.left_out.append(Omission(stage, what, "found in the store", 1.0, entry.seconds))
