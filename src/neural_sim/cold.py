"""A detector trained from scratch on images of one distribution, and what that cost."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.retinanet import Detector
from neural_sim.detector.training import train_detector
from neural_sim.devices import placed, synchronise
from neural_sim.outer.records import Cost
from neural_sim.settings import Training
from neural_sim.synthesis.scene import Scene, join


def train_cold(
    scene: Scene,
    detector: Detector,
    training: Training,
    psi: Float[Tensor, "objects K"],
    epochs: int,
    generator: torch.Generator,
    device: torch.device,
) -> dict[str, Any]:
    """The budget of ``training`` spent on images drawn from ``psi``, the same whatever method chose psi.

    Returns the parameters, on the CPU (``params``), and their :class:`Cost` as a dictionary (``cost``): rendering and
    training, without the fields, which all methods share.
    """
    begun, cpu_begun = time.perf_counter(), time.process_time()
    images = join(scene.training_set(psi, training.images_per_object, generator))
    params, history = train_detector(
        detector, placed(detector.init(generator), device), images, generator, epochs=epochs,
        batch_size=training.batch_size, learning_rate=training.learning_rate,
        weight_decay=training.weight_decay, progress=False,
    )  # fmt: skip
    synchronise(device)
    cost = Cost(
        images=len(images),
        detector_steps=history.steps,
        seconds=time.perf_counter() - begun,
        cpu_seconds=time.process_time() - cpu_begun,
    )
    return {"params": placed(params, torch.device("cpu")), "cost": dataclasses.asdict(cost)}
