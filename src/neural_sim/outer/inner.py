"""What all methods share: images drawn from p_psi, a detector trained on them, its loss on the target set."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.training import Training, train_detector
from neural_sim.detector.trajectory import Recording, Trajectory
from neural_sim.devices import placed, synchronise
from neural_sim.outer.objective import Objective
from neural_sim.outer.settings import Outer
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.draws import HARD, Draws, HardDraws
from neural_sim.synthesis.pool import ImagePool
from neural_sim.synthesis.scene import Scene
from neural_sim.types import LabelledImages


@contextmanager
def timed(seconds: dict[str, float], phase: str, device: torch.device) -> Iterator[None]:
    """Add the seconds spent inside, the device's work for it included, to those of a phase."""
    begin = time.perf_counter()
    yield
    synchronise(device)
    seconds[phase] = seconds.get(phase, 0.0) + time.perf_counter() - begin


def pooled(settings: Outer, draws: Draws, distribution: SceneDistribution) -> bool:
    """Whether images come from a pool: where none is differentiated and the light does not move."""
    return settings.pool_per_bin > 0 and isinstance(draws, HardDraws) and not distribution.lights


class InnerLoop:
    """The inner problem of Eq. 1: ``theta`` after training on images of one psi.

    The detector has the backbone of ``params``, frozen; its pyramid and head train ``settings.epochs`` epochs each time
    an iteration asks, on the device of ``params``, where the scene's fields are too. ``validation`` is the labelled
    target set, anywhere; no step sees any other real image. ``draws`` says how the method wants images drawn. Relaxed
    ones, and those under a light that moves, are always rendered anew, all others come from a pool of every bin.
    The batch size and the decay of its steps are those of ``training``.
    With ``common_numbers`` all draws and trainings use the same random numbers, so that they differ by psi alone.
    ``images`` and ``steps`` count labelled images made and optimiser steps; ``cpu_begun`` is the processor time at
    which the pool was begun.
    """

    def __init__(
        self,
        scene: Scene,
        detector: Detector,
        params: Parameters,
        validation: LabelledImages,
        settings: Outer,
        training: Training,
        generator: torch.Generator,
        draws: Draws = HARD,
    ) -> None:
        self.scene, self.detector, self.theta, self.settings = scene, detector, params, settings
        self.training, self.generator = training, generator
        self.backbone, self.warm_start = detector.split(params)
        self.validation = CachedSet.of(detector, self.backbone, validation)
        self.draws, self.device = draws, self.validation.device
        self.pool: ImagePool | None = None
        begun, self.cpu_begun = time.perf_counter(), time.process_time()
        if pooled(settings, draws, scene.distribution):
            self.pool = ImagePool.render(scene, settings.pool_per_bin, generator)
        synchronise(self.device)
        self.pool_seconds = time.perf_counter() - begun
        self._start = params
        if settings.start != "warm":
            self._start = {**placed(detector.init(generator), self.device), **self.backbone}
        self.objective = Objective(self.validation, validation, settings.objective, settings.smooth_ap)
        self.images = self.steps = self._numbers = 0
        self.common_numbers = False
        self.trajectory: Trajectory | None = None
        self._judged: tuple[Parameters, Outputs] = ({}, (torch.empty(0), torch.empty(0)))

    @property
    def trainable(self) -> Parameters:
        """The trained part of theta."""
        return self.detector.split(self.theta)[1]

    def draw(self, psi: Float[Tensor, "objects K"]) -> RenderedImages:
        """An iteration's training images."""
        rendered = self.scene.training_set(
            psi, self.settings.images_per_object, self._common(0), self.draws, self.pool
        )
        self.images += len(rendered)
        return rendered

    def _common(self, purpose: int) -> torch.Generator:
        """The same random numbers every time until :meth:`renew`, or new ones."""
        if not self.common_numbers:
            return self.generator
        seed = self.generator.initial_seed() + 2_000_003 * (1 + self._numbers) + purpose
        return torch.Generator().manual_seed(seed)

    def renew(self) -> None:
        """Other random numbers from now on."""
        self._numbers += 1

    def train(self, images: CachedSet, recording: Recording | None = None) -> float:
        """Train theta on the images; returns the last epoch's loss, nan where there are no epochs.

        What ``recording`` wants kept of the steps is in ``trajectory``.
        """
        if self.settings.epochs == 0:
            return math.nan
        how = replace(self.training.of(self.settings.epochs), learning_rate=self.settings.learning_rate)
        # The proximal term takes the decay's place: with both, its Hessian would not be the inner problem's.
        if self.detector.proximal > 0.0:
            how = replace(how, weight_decay=0.0)
        start = self.theta if self.settings.start == "previous" else self._start
        self.theta, history = train_detector(
            self.detector, start, images, self._common(1), how, self.warm_start, recording
        )
        self.steps += history.steps
        self.trajectory = history.trajectory
        return history.losses[-1]

    @torch.no_grad()
    def loss(self, images: CachedSet) -> float:
        """Mean loss of images at theta."""
        return float(sum(term(self.trainable) for term in images.mean_terms()))

    def validation_loss(self) -> float:
        """L_val at theta."""
        return float(self.objective.of_outputs(self._on_validation()))

    def scores(self) -> Float[Tensor, "classes images"]:
        """What each validation image adds to theta's score for each class, more is better."""
        return self.objective.scores(self._on_validation())

    @torch.no_grad()
    def _on_validation(self) -> Outputs:
        """theta's outputs on the validation images, computed once for each theta."""
        theta, outputs = self._judged
        if theta is not self.theta:
            outputs = self.objective.outputs(self.trainable)
            self._judged = (self.theta, outputs)
        return outputs
