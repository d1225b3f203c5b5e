"""Stages of detectors trained on images of one distribution, with or without photographs, or on photographs alone."""

from __future__ import annotations

import dataclasses
import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.real import Sampling
from neural_sim.detector.training import Training, train_detector
from neural_sim.devices import placed, synchronise
from neural_sim.outer.records import Cost
from neural_sim.randomness import stream
from neural_sim.stages.scene import TrainingImages, TrainingImagesStage
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.synthesizer import unshown
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)

CPU = torch.device("cpu")


@dataclass(frozen=True)
class TrainedDetector:
    """Parameters, and the cost of rendering and training. The cost excludes fields, since all methods use them."""

    params: Parameters
    cost: Cost


class TrainedStage(Stage[TrainedDetector]):
    """A trained detector of the classes ``names``, for images taken by ``camera``."""

    kind: ClassVar[str] = "detector"

    detector: Callable[..., Detector]
    device: torch.device

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the classes, in label order."""

    @property
    @abstractmethod
    def camera(self) -> PinholeCamera:
        """Camera of the images."""

    def build(self) -> Detector:
        """Return the detector, without parameters."""
        camera = self.camera
        return self.detector(num_classes=len(self.names), image_size=(camera.height, camera.width))

    @override
    def check(self) -> None:
        self.build()  # raises if initial weights are missing or do not fit

    @override
    def pack(self, value: TrainedDetector) -> dict[str, Any]:
        return {"params": placed(value.params, CPU), "cost": dataclasses.asdict(value.cost)}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> TrainedDetector:
        return TrainedDetector(placed(stored["params"], self.device), Cost(**stored["cost"]))


@dataclass(frozen=True)
class DetectorStage(TrainedStage):
    """A detector trained from its initial parameters on images drawn from psi, with the same budget for every method.

    ``probabilities`` is the digest of p, see ``SceneDistribution.digest_of``; ``phase`` is the phase of the run that
    needs the detector; ``called`` describes psi in messages. ``targets`` are the target sets whose photographs are
    mixed into the training if ``training.real`` says so, else None.
    """

    scene: TrainingImagesStage
    detector: Callable[..., Detector]
    training: Training
    epochs: int
    probabilities: str
    seed: int
    psi: Float[Tensor, "objects K"] = field(metadata=UNKEYED)
    phase: str = field(metadata=UNKEYED)
    called: str = field(metadata=UNKEYED)
    device: torch.device = field(default=CPU, metadata=UNKEYED)
    targets: TargetSetsStage | None = None

    @property
    @override
    def title(self) -> str:
        return f"detector trained on {self.called}" + ("" if self.targets is None else " and photographs")

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return self.scene.names

    @property
    @override
    def camera(self) -> PinholeCamera:
        return self.scene.camera

    def photographs(self, results: Results) -> LabelledImages | None:
        """Return the photographs that are mixed with the drawn images, None if there are none."""
        if self.targets is None:
            return None
        return self.training.real.chosen(results(self.targets).train, self.seed)

    def images(self, results: Results, generator: torch.Generator | None = None) -> RenderedImages:
        """Return the training images; without a ``generator``, they are the same in every call."""
        generator = self.generator() if generator is None else generator
        scene: TrainingImages = results(self.scene)
        return scene.training_set(self.psi, self.training.images_per_object, generator)

    def generator(self) -> torch.Generator:
        """Return a new generator, from which images, initial parameters and the order of training are drawn."""
        return stream(self.seed, "detector")

    @override
    def make(self, results: Results) -> TrainedDetector:
        # Made before the clock starts, so that the cost excludes the fields and the target sets.
        _, photographs = results(self.scene), self.photographs(results)
        detector, training, generator = self.build(), self.training, self.generator()
        begun, cpu_begun = time.perf_counter(), time.process_time()
        images, sampling = self.images(results, generator).images.to(self.device), None
        if unseen := unshown(images, self.names):
            _log.warning(
                "%s: no drawn image shows %s, which it therefore cannot learn: want shorter distances (parameter, "
                "unlearned), larger images (training.image_size), or a smaller synthesis.minimum_area",
                self.title, ", ".join(unseen),
            )  # fmt: skip
        drawn = len(images)
        if photographs is not None:
            images = LabelledImages.concatenate([images, photographs.to(self.device)])
            sampling = training.real.sampling(drawn, len(photographs), training.batch_size)
        params, history = train_detector(
            detector,
            placed(detector.init(generator), self.device),
            images,
            generator,
            training.of(self.epochs),
            sampling=sampling,
        )
        synchronise(self.device)
        cost = Cost(
            images=drawn,
            detector_steps=history.steps,
            seconds=time.perf_counter() - begun,
            cpu_seconds=time.process_time() - cpu_begun,
        )
        return TrainedDetector(params, cost)


@dataclass(frozen=True)
class PhotographsStage(TrainedStage):
    """A detector trained on the target's photographs from its initial parameters, or fine-tuned from ``start``.

    Training takes ``epochs`` epochs of ``steps`` steps, which pass over the photographs in shuffled order. A batch has
    the size in ``training``, or contains all photographs if there are fewer.
    """

    phase: ClassVar[str] = "evaluate"

    start: DetectorStage | None
    targets: TargetSetsStage
    image_camera: PinholeCamera
    class_names: tuple[str, ...]
    detector: Callable[..., Detector]
    training: Training
    epochs: int
    steps: int
    seed: int
    device: torch.device = field(default=CPU, metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        if self.start is None:
            return "detector trained on photographs only"
        return f"{self.start.title}, fine-tuned on photographs"

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return self.class_names

    @property
    @override
    def camera(self) -> PinholeCamera:
        return self.image_camera

    @override
    def make(self, results: Results) -> TrainedDetector:
        detector, training = self.build(), self.training
        generator = stream(self.seed, "fine-tuning")
        photographs = training.real.chosen(results(self.targets).train, self.seed).to(self.device)
        start = None if self.start is None else results(self.start)  # its cost is added below
        begun, cpu_begun = time.perf_counter(), time.process_time()
        initial = placed(detector.init(generator), self.device) if start is None else start.params
        how = training.of(self.epochs)
        if start is not None:
            how = replace(how, learning_rate=training.real.finetune_learning_rate)
        count = len(photographs)
        sampling = Sampling((count,), (min(training.batch_size, count),), self.steps)
        params, history = train_detector(detector, initial, photographs, generator, how, sampling=sampling)
        synchronise(self.device)
        cost = Cost(
            detector_steps=history.steps,
            seconds=time.perf_counter() - begun,
            cpu_seconds=time.process_time() - cpu_begun,
        )
        return TrainedDetector(params, cost if start is None else cost + start.cost)
