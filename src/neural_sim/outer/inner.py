"""The inner problem, which all methods share: images drawn from p_psi, and a detector trained on them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.real import Sampling
from neural_sim.detector.training import Training, TrainingHistory, train_detector
from neural_sim.detector.trajectory import Recording, Trajectory
from neural_sim.devices import placed, synchronise
from neural_sim.outer.objective import Objective
from neural_sim.outer.records import Cost
from neural_sim.outer.settings import Outer
from neural_sim.parameter.product import HARD, Draws, HardDraws, SceneDistribution
from neural_sim.randomness import stream
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.pool import pool_of
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages


@contextmanager
def timed(seconds: dict[str, float], phase: str, device: torch.device) -> Iterator[None]:
    """Add the time spent in the block, including the device's work, to a phase's seconds."""
    begin = time.perf_counter()
    yield
    synchronise(device)
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - begin


def pooled(settings: Outer, draws: Draws, distribution: SceneDistribution) -> bool:
    """Tell whether images come from a pool, which needs ``pool_per_bin`` above 0, hard draws and a fixed light."""
    return settings.pool_per_bin > 0 and isinstance(draws, HardDraws) and not distribution.lights


@dataclass(frozen=True)
class Numbers:
    """The random numbers of trainings.

    Attributes:
        generator: the loop's generator.
        common: whether all draws and trainings use the same random numbers, so that they differ by psi alone.
        index: which set of common random numbers is in use.
    """

    generator: torch.Generator
    common: bool = False
    index: int = 0

    def of(self, purpose: str) -> torch.Generator:
        """Return the generator for a training's ``images`` or for the ``training`` itself."""
        return stream(self.index, f"common {purpose}", self.generator) if self.common else self.generator

    def renewed(self) -> Numbers:
        """Return another set of common random numbers."""
        return replace(self, index=self.index + 1)


@dataclass(frozen=True)
class RenderedPool:
    """A pool of renders, with the state of the generator after them.

    Attributes:
        scene: the scene of the pooled renders.
        state: the generator's state after the renders, from which a loop with this pool continues.
        spent: cost of the renders.
    """

    scene: Scene
    state: Tensor
    spent: Cost

    @staticmethod
    def of(scene: Scene, per_bin: int, generator: torch.Generator, *, lights: bool = False) -> RenderedPool:
        """Render a pool; see ``pool_of``."""
        began, cpu_began = time.perf_counter(), time.process_time()
        pool = pool_of(scene, per_bin, generator, lights=lights)
        synchronise(pool.subjects[0].device)
        spent = Cost(seconds=time.perf_counter() - began, cpu_seconds=time.process_time() - cpu_began)
        return RenderedPool(pool, generator.get_state(), spent)


@dataclass(frozen=True)
class LoopInputs:
    """The inputs of a psi loop.

    Attributes:
        detector: the detector.
        params: its warm start, on the device of the scene's fields, where the loop trains.
        validation: the labelled validation set, on any device; the loop sees no other images of the target.
        photographs: labelled photographs on which the loop trains in addition, as ``training.real`` says.
        pool: a pool that was rendered earlier with the loop's generator; None: the loop renders one if it needs it.
    """

    detector: Detector
    params: Parameters
    validation: LabelledImages
    photographs: LabelledImages | None = None
    pool: RenderedPool | None = None


@dataclass(frozen=True)
class Trained:
    """A detector trained on images drawn at one psi, or a detector trained elsewhere, paired with such images.

    Attributes:
        psi: the psi from which the images were drawn.
        rendered: the drawn images.
        examples: the training set: these images and the photographs, passed through the backbone.
        theta: the detector's parameters.
        trainable: the part of them that is trained.
        loss: mean training loss of the last epoch, or the loss of a detector trained elsewhere; nan without epochs.
        trajectory: the steps, if they were recorded.
        objective: L_val.
        cost: images and steps.
        seconds: seconds by phase: render, features, train.
    """

    psi: Float[Tensor, "objects K"]
    rendered: RenderedImages
    examples: CachedSet
    theta: Parameters
    trainable: Parameters
    loss: float
    trajectory: Trajectory | None
    objective: Objective
    cost: Cost
    seconds: Mapping[str, float]

    @cached_property
    def _outputs(self) -> Outputs:
        with torch.no_grad():
            return self.objective.outputs(self.trainable)

    @property
    def validation_loss(self) -> float:
        """L_val."""
        return float(self.objective.of_outputs(self._outputs))

    @property
    def unseen(self) -> Bool[Tensor, "classes"]:
        """The classes that the detector hardly ever finds; see ``Objective.unseen``."""
        return self.objective.unseen(self._outputs)

    @property
    def scores(self) -> Float[Tensor, "classes images"]:
        """Each validation image's contribution to the score of each class; higher is better."""
        return self.objective.scores(self._outputs)


@dataclass(frozen=True)
class InnerLoop:
    """The inner problem of Eq. 1: theta after training on images at one psi.

    The backbone is the one in ``params``, frozen except for its last ``settings.loop_layers`` stages. These stages, the
    pyramid and the head are trained for ``settings.epochs`` epochs at a time, or more if ``settings.least_steps``
    requires it. Images come from a pool of renders of every bin, or are rendered for every training if draws are
    relaxed, a light is learned, or ``settings.pool_per_bin`` is 0.

    Attributes:
        scene: the scene from which images are drawn.
        detector: the detector as the loop trains it.
        params: its warm start.
        start: initial parameters of a training that does not continue the previous one.
        objective: L_val.
        photographs: the photographs on which it trains in addition to the drawn images.
        settings: settings of the psi loop.
        training: batch size and weight decay.
        draws: how the method draws images.
        pool: the scene with renders that are made once, if there is one.
        preparation: cost of rendering the pool.
    """

    scene: Scene
    detector: Detector
    params: Parameters
    start: Parameters
    objective: Objective
    photographs: CachedSet | None
    settings: Outer
    training: Training
    draws: Draws = HARD
    pool: Scene | None = None
    preparation: Cost = field(default_factory=Cost)

    @staticmethod
    def prepare(
        scene: Scene,
        inputs: LoopInputs,
        settings: Outer,
        training: Training,
        generator: torch.Generator,
        draws: Draws = HARD,
    ) -> InnerLoop:
        """Render the pool, and draw the initial parameters of trainings."""
        detector, params = inputs.detector.in_loop(settings.loop_layers), inputs.params
        backbone, _ = detector.split(params)
        validation = CachedSet.of(detector, backbone, inputs.validation)
        photographs = None
        if inputs.photographs is not None:
            photographs = CachedSet.of(detector, backbone, inputs.photographs)
        pool = inputs.pool
        if pool is not None:
            generator.set_state(pool.state)
        elif pooled(settings, draws, scene.distribution):
            pool = RenderedPool.of(scene, settings.pool_per_bin, generator)
        start = params
        if settings.start != "warm":
            warm = {name: value for name, value in params.items() if name.startswith("backbone.")}
            start = {**placed(detector.init(generator), validation.device), **warm}
        objective = Objective(validation, inputs.validation, settings.objective)
        return InnerLoop(
            scene, detector, params, start, objective, photographs, settings, training, draws,
            None if pool is None else pool.scene, Cost() if pool is None else pool.spent,
        )  # fmt: skip

    @property
    def backbone(self) -> Parameters:
        """The frozen part of the parameters."""
        return self.detector.split(self.params)[0]

    @property
    def warm_start(self) -> Parameters:
        """The trained part of the parameters at the warm start."""
        return self.detector.split(self.params)[1]

    @property
    def device(self) -> torch.device:
        """The device on which the loop trains."""
        return self.objective.cached.device

    @property
    def shown(self) -> set[int]:
        """The classes that validation images show."""
        labels = self.objective.images.labels
        return set(labels[labels >= 0].tolist())

    def draw(self, psi: Float[Tensor, "objects K"], numbers: Numbers) -> RenderedImages:
        """Draw training images; maps are kept only if a derivative goes through them."""
        scene, count = self.pool or self.scene, self.settings.images_per_object
        rendered = scene.training_set(psi, count, numbers.of("images"), self.draws)
        return rendered.without_maps() if isinstance(self.draws, HardDraws) else rendered

    def training_set(self, images: LabelledImages) -> CachedSet:
        """Pass drawn images through the backbone, and append the photographs, if there are any."""
        drawn = CachedSet.of(self.detector, self.backbone, images)
        return drawn if self.photographs is None else CachedSet.concatenate([drawn, self.photographs])

    def weights(self, examples: CachedSet) -> Float[Tensor, "N"]:
        """Return the examples' weights in the training loss, on the CPU.

        They are 1 / N each, unless photographs have a fixed fraction of every batch.
        """
        sampling = self._sampling(examples)
        return torch.full((len(examples),), 1.0 / len(examples)) if sampling is None else sampling.weights

    def _sampling(self, examples: CachedSet) -> Sampling | None:
        if self.photographs is None:
            return None
        count = len(self.photographs)
        return self.training.real.sampling(len(examples) - count, count, self.training.batch_size)

    def train(
        self,
        psi: Float[Tensor, "objects K"],
        numbers: Numbers,
        theta: Parameters | None = None,
        recording: Recording | None = None,
    ) -> Trained:
        """Train on images at psi.

        Args:
            psi: the images are drawn from p_psi.
            numbers: random numbers of the draws and the training.
            theta: initial parameters if ``settings.start=previous``; None: the warm start.
            recording: which steps are recorded; None: none.
        """
        theta = self.params if theta is None else theta
        seconds: dict[str, float] = {}
        rendered, examples = self._examples(psi, numbers, seconds)
        history = None
        with timed(seconds, "train", self.device):
            if self.settings.epochs > 0:
                theta, history = self._fit(examples, numbers, theta, recording)
        return self._trained(psi, rendered, examples, theta, seconds, history)

    def untrained(self, psi: Float[Tensor, "objects K"], numbers: Numbers, theta: Parameters) -> Trained:
        """Draw images at psi for a detector that was trained elsewhere, and evaluate its loss on them."""
        seconds: dict[str, float] = {}
        rendered, examples = self._examples(psi, numbers, seconds)
        with timed(seconds, "train", self.device):
            loss = self.loss(examples, theta)
        return replace(self._trained(psi, rendered, examples, theta, seconds), loss=loss)

    def _examples(
        self, psi: Float[Tensor, "objects K"], numbers: Numbers, seconds: dict[str, float]
    ) -> tuple[RenderedImages, CachedSet]:
        with timed(seconds, "render", self.device):
            rendered = self.draw(psi, numbers)
        with timed(seconds, "features", self.device):
            return rendered, self.training_set(rendered.images)

    def _fit(
        self, examples: CachedSet, numbers: Numbers, theta: Parameters, recording: Recording | None
    ) -> tuple[Parameters, TrainingHistory]:
        sampling = self._sampling(examples)
        how = self.training.of(self._epochs(len(examples), sampling))
        how = replace(how, learning_rate=self.settings.learning_rate)
        # The proximal term replaces weight decay, which the Hessian of the inner problem does not include.
        if self.detector.proximal > 0.0:
            how = replace(how, weight_decay=0.0)
        start = theta if self.settings.start == "previous" else self.start
        return train_detector(
            self.detector,
            start,
            examples,
            numbers.of("training"),
            how,
            self.warm_start,
            recording,
            sampling,
        )

    def _epochs(self, images: int, sampling: Sampling | None) -> int:
        """Compute the number of epochs from ``outer.epochs`` and ``outer.least_steps``."""
        if self.settings.start == "previous":
            return self.settings.epochs
        steps = math.ceil(images / self.training.batch_size) if sampling is None else sampling.steps
        return max(self.settings.epochs, math.ceil(self.settings.least_steps / steps))

    def _trained(
        self,
        psi: Float[Tensor, "objects K"],
        rendered: RenderedImages,
        examples: CachedSet,
        theta: Parameters,
        seconds: Mapping[str, float],
        history: TrainingHistory | None = None,
    ) -> Trained:
        return Trained(
            psi=psi.detach().clone(),
            rendered=rendered,
            examples=examples,
            theta=theta,
            trainable=self.detector.split(theta)[1],
            loss=math.nan if history is None else history.losses[-1],
            trajectory=None if history is None else history.trajectory,
            objective=self.objective,
            cost=Cost(images=len(rendered), detector_steps=0 if history is None else history.steps),
            seconds=seconds,
        )

    @torch.no_grad()
    def loss(self, examples: CachedSet, theta: Parameters) -> float:
        """Compute the training loss of a ``training_set`` at theta."""
        trainable, weights = self.detector.split(theta)[1], self.weights(examples).to(self.device)
        rows = torch.arange(len(examples), device=self.device).split(32)
        return float(sum(examples.losses(trainable, part) @ weights[part] for part in rows))
