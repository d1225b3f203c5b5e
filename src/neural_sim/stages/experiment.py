"""The parts of a run as configured, built and validated."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.configuration import UserError
from neural_sim.detector.protocol import Detector, Score, score_of
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.detector.training import Training
from neural_sim.extras import require
from neural_sim.field.recipe import FieldRecipe
from neural_sim.gradient.estimators import Estimator
from neural_sim.objects.mesh import MeshSource
from neural_sim.objects.photos import Photos
from neural_sim.outer.objective import Loss
from neural_sim.outer.settings import Outer
from neural_sim.parameter.coverage import Coverage
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.views import Views
from neural_sim.report.model_files import ModelFiles
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.psi import Method
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.base import Target
from neural_sim.types import PinholeCamera
from neural_sim.workers import Workers

SCORES: dict[str, Score] = {"detection": "AP", "classification": "accuracy"}
"""The score of each task's detectors."""
_OBJECTIVES = {"AP": ("smooth_ap", SmoothAP), "accuracy": ("smooth_accuracy", SmoothAccuracy)}
"""For each score, the psi loop's objective other than the loss: its name in ``outer/objective``, and its class."""


@dataclass(frozen=True)
class Run:
    """Name, seed, paths and resources of a run.

    ``score_at`` are fractions of a method's iterations, in (0, 1]; ``task`` is one of ``SCORES``; with ``resume``,
    unfinished work of killed runs is resumed. ``workers`` make independent results in parallel; on a cluster, each
    result takes the fraction ``worker_gpus`` of a GPU.

    Raises:
        UserError: several processes would share a GPU.
        ValueError: a cluster is asked for, but Ray is not installed.
    """

    name: str
    seed: int
    store: Path
    mlflow: str
    accelerator: str = "cpu"
    progress: bool = False
    resume: bool = True
    workers: Workers = 1
    worker_gpus: float = 0.25
    score_at: tuple[float, ...] = ()
    task: str = "detection"

    def __post_init__(self) -> None:
        if self.workers == "ray":
            require("ray", "workers=ray")
        elif self.workers > 1 and self.accelerator != "cpu":
            raise UserError(
                f"workers: want 1 or ray with trainer=gpu, got {self.workers} processes, which would share the GPU"
            )

    @property
    def gpus(self) -> float:
        """Fraction of a GPU that each result takes on a cluster."""
        return 0.0 if self.accelerator == "cpu" else self.worker_gpus


@dataclass(frozen=True)
class Imaging:
    """Settings of all images: of objects (``views``, ``field``, ``renderer``, ``synthesis``) and of the target.

    ``camera`` takes the synthesised images and, if they are rendered, the target images. ``coverage`` says by object
    and factor which bins photographs show; it has no entries for meshes.

    Raises:
        ValueError: the renderer cannot draw these fields.
    """

    objects: MeshSource | Photos
    views: Views
    field: FieldRecipe
    renderer: NerfRenderer
    synthesis: Synthesizer
    target: Target
    camera: PinholeCamera
    distribution: SceneDistribution
    coverage: Mapping[str, Mapping[str, Coverage]] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        kind = self.field.kind
        if kind is not None:
            self.renderer.check(kind)


@dataclass(frozen=True)
class Loop:
    """The method that learns psi. ``gradient`` and ``solver`` are for methods that follow the hypergradient."""

    method: Method
    outer: Outer
    gradient: Estimator
    solver: AdjointSolver


@dataclass(frozen=True)
class Experiment:
    """All parts of a run.

    ``config`` is the configuration that they were built from, used in reports only; ``model`` says which files the
    report writes for the final detector.

    Raises:
        ValueError: the detector, the objective or the images do not fit the task; the first hypergradient would be
            taken at a warm start that was not trained on the initial psi; or the method compares trainings, and each of
            them continues the one before.
    """

    run: Run
    imaging: Imaging
    detector: Callable[..., Detector]
    training: Training
    loop: Loop
    config: dict[str, Any]
    model: ModelFiles

    def __post_init__(self) -> None:
        task, score, objective = self.run.task, self.score, self.loop.outer.objective
        if score != SCORES.get(task):
            choices = ", ".join(f"task={name} ({own})" for name, own in SCORES.items())
            raise ValueError(
                f"task={task} does not go with a detector that is scored by {score}: want {choices}, and "
                "detector=classifier for accuracy"
            )
        method = self.loop.method
        if self.loop.outer.start == "previous" and not isinstance(
            method, (Fixed, LabelShift, HypergradientLoop)
        ):
            raise ValueError(
                f"baseline={method.name} compares trainings, and with outer.start=previous (as in +variant=paper) "
                "later ones score higher whatever psi is: add outer.start=warm"
            )
        name, wanted = _OBJECTIVES[score]
        if not isinstance(objective, (wanted, Loss)):
            raise ValueError(
                f"outer/objective: want {name} or loss for task={task}, got {type(objective).__name__}"
            )
        if not self.loop.outer.train_first and self.training.warm_start != "initial":
            raise ValueError(
                "outer.train_first=false takes the first hypergradient at the warm start: want "
                f"training.warm_start=initial, got {self.training.warm_start}"
            )
        if score == "AP" and not self.imaging.target.boxed:
            raise ValueError(
                f"target: its photographs have no boxes, want task=classification, got task={task}"
            )
        if score == "accuracy" and self.imaging.synthesis.several:
            raise ValueError(
                f"synthesis.objects_per_image: want [1, 1] for task={task}, whose images show one object each, got "
                f"{list(self.imaging.synthesis.objects_per_image)}"
            )

    @property
    def score(self) -> Score:
        """The score of the detectors."""
        return score_of(self.detector)

    def check_boxes(self, key: str) -> None:
        """Raise ``ValueError`` if detectors are not scored by AP, which the task ``key`` needs."""
        if self.score != "AP":
            raise ValueError(f"{key} compares boxes: want task=detection, got task={self.run.task}")
