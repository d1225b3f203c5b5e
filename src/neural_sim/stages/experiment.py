"""A run as it was asked for: its parts, built and validated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.detector.protocol import Detector
from neural_sim.detector.training import Training
from neural_sim.field.recipe import FieldRecipe
from neural_sim.gradient.estimators import Estimator
from neural_sim.objects.photos import Photos
from neural_sim.outer.settings import Outer
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.views import Views
from neural_sim.report.model_files import ModelFiles
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.meshes import ObjectSource
from neural_sim.stages.psi import Method
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import PinholeCamera


@dataclass(frozen=True)
class Run:
    """What a run is called and where it works. ``score_at`` are parts of a method's iterations, in (0, 1]."""

    name: str
    seed: int
    store: Path
    mlflow: str
    accelerator: str = "cpu"
    progress: bool = False
    score_at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Imaging:
    """What makes images: of objects (``views``, ``field``, ``renderer``, ``synthesis``), and of the target. ``camera``
    is that of synthesised and of rendered target images."""

    objects: ObjectSource | Photos
    views: Views
    field: FieldRecipe
    renderer: NerfRenderer
    synthesis: Synthesizer
    target: Any
    camera: PinholeCamera
    distribution: SceneDistribution


@dataclass(frozen=True)
class Loop:
    """What moves psi. ``gradient`` and ``solver`` serve methods that follow the hypergradient."""

    method: Method
    outer: Outer
    gradient: Estimator
    solver: AdjointSolver


@dataclass(frozen=True)
class Experiment:
    """All parts of a run; ``config`` is the configuration that they were built from, for reports alone, ``model`` what
    the report writes of the final detector."""

    run: Run
    imaging: Imaging
    detector: Callable[..., Detector]
    training: Training
    loop: Loop
    config: dict[str, Any]
    model: ModelFiles
