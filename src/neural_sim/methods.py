"""From a configured method to the outer loop that runs it."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.detector.retinanet import Detector, Parameters
from neural_sim.experiment import Experiment
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.loop import OuterLoop
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.rewarded import RewardLoop
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages


def outer_loop(
    experiment: Experiment,
    scene: Scene,
    detector: Detector,
    warm_start: Parameters,
    psi: Float[Tensor, "objects K"],
    validation: LabelledImages,
    generator: torch.Generator,
) -> OuterLoop:
    """The loop of the experiment's method from ``psi``, on renders of ``outer.quality``.

    Raises:
        ValueError: a method that optimises nothing.
    """
    method, outer, training = experiment.baseline, experiment.outer, experiment.training
    if isinstance(method, Fixed):
        raise ValueError(f"baseline={method.name} has no outer loop")
    if outer.quality is not None:
        scene = replace(scene, renderer=scene.renderer.at(outer.quality))
    inner = InnerLoop(
        scene, detector, warm_start, validation, outer, training.batch_size, training.weight_decay, generator,
        experiment.draws,
    )  # fmt: skip
    if isinstance(method, HypergradientLoop):
        return SimulatorModule(inner, psi, experiment.gradient, experiment.solver)
    return RewardLoop(inner, psi, method)
