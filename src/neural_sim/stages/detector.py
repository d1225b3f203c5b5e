"""Stages ``warm_start`` and ``evaluate``: detectors trained from scratch on images of one distribution."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.training import Training, train_detector
from neural_sim.devices import placed, synchronise
from neural_sim.outer.cost import Cost
from neural_sim.stages.scene import SceneStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.scene import Scene

CPU = torch.device("cpu")


@dataclass(frozen=True)
class TrainedDetector:
    """Parameters, and the cost of rendering and training, without that of the fields, which all methods use."""

    params: Parameters
    cost: Cost


@dataclass(frozen=True)
class DetectorStage(Stage[TrainedDetector]):
    """A detector trained from scratch on images drawn from psi, with the same budget for every method.

    ``probabilities`` is the digest of p, see :meth:`SceneDistribution.digest_of`; ``name`` is that of the stage that
    needs the detector, ``called`` describes psi in messages.
    """

    kind: ClassVar[str] = "detector"

    scene: SceneStage
    detector: Callable[..., Detector]
    training: Training
    epochs: int
    probabilities: str
    seed: int
    psi: Float[Tensor, "objects K"] = field(metadata=UNKEYED)
    name: str = field(metadata=UNKEYED)
    called: str = field(metadata=UNKEYED)
    device: torch.device = field(default=CPU, metadata=UNKEYED)

    @property
    def title(self) -> str:
        return f"detector trained on {self.called}"

    def build(self) -> Detector:
        """The detector's shape, without parameters."""
        camera = self.scene.camera
        return self.detector(num_classes=len(self.scene.names), image_size=(camera.height, camera.width))

    def images(self, scene: Scene, generator: torch.Generator | None = None) -> RenderedImages:
        """The training images, equal in every call."""
        generator = self.generator() if generator is None else generator
        return scene.training_set(self.psi, self.training.images_per_object, generator)

    def generator(self) -> torch.Generator:
        """Of images, new parameters and the order of training."""
        return torch.Generator().manual_seed(1_000_003 * (self.seed + 1) + 1)

    def make(self, results: Results) -> TrainedDetector:
        scene, detector, training, generator = (
            results(self.scene),
            self.build(),
            self.training,
            self.generator(),
        )
        begun, cpu_begun = time.perf_counter(), time.process_time()
        images = self.images(scene, generator).images
        params, history = train_detector(
            detector,
            placed(detector.init(generator), self.device),
            images,
            generator,
            training.of(self.epochs),
        )
        synchronise(self.device)
        cost = Cost(
            images=len(images),
            detector_steps=history.steps,
            seconds=time.perf_counter() - begun,
            cpu_seconds=time.process_time() - cpu_begun,
        )
        return TrainedDetector(params, cost)

    def pack(self, value: TrainedDetector) -> dict[str, Any]:
        return {"params": placed(value.params, CPU), "cost": dataclasses.asdict(value.cost)}

    def unpack(self, stored: Mapping[str, Any]) -> TrainedDetector:
        return TrainedDetector(placed(stored["params"], self.device), Cost(**stored["cost"]))
