"""The inner problem, common to all methods: images drawn from p_psi, and a detector trained on them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.real import Sampling
from neural_sim.detector.training import Training, train_detector
from neural_sim.detector.trajectory import Recording, Trajectory
from neural_sim.devices import placed, synchronise
from neural_sim.outer.objective import Objective
from neural_sim.outer.settings import Outer
from neural_sim.parameter.product import HARD, Draws, HardDraws, SceneDistribution
from neural_sim.randomness import stream
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.pool import pool_of
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
    """Whether images come from a pool: where images are not differentiated and the light is fixed."""
    return settings.pool_per_bin > 0 and isinstance(draws, HardDraws) and not distribution.lights


class InnerLoop:
    """The inner problem of Eq. 1: ``theta`` after training on images of one psi.

    The backbone is that of ``params``, frozen but for its last ``settings.loop_layers`` stages. These, pyramid and
    head are trained for ``settings.epochs`` epochs at a time, more where ``settings.least_steps`` asks for them, on
    the device of ``params``, where the scene's fields are too. Relaxed draws, and images under a light that moves,
    are always rendered anew; all others come from a pool of poses of every bin.

    Args:
        scene: what images are drawn from.
        detector, params: the detector and its warm start.
        validation: the labelled target set, on any device; the loop sees no other images of the target.
        settings: of the psi loop.
        training: batch size and weight decay.
        generator: of all draws.
        draws: how the method draws images.
        photographs: labelled ones that every training has beside the drawn images, as ``training.real`` says.

    With ``common_numbers`` all draws and trainings use the same random numbers, so that they differ by psi alone.
    ``objective`` is L_val, ``differentiated`` the part of it whose derivative is taken: all, unless it was replaced.
    ``shown`` are the classes of which a validation image shows an object. ``images`` and ``steps`` count labelled
    images and optimiser steps; ``cpu_begun`` is the processor time before the pool was rendered.
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
        photographs: LabelledImages | None = None,
    ) -> None:
        detector = detector.in_loop(settings.loop_layers)
        self.scene, self.detector, self.theta, self.settings = scene, detector, params, settings
        self.training, self.generator = training, generator
        self.backbone, self.warm_start = detector.split(params)
        self.validation = CachedSet.of(detector, self.backbone, validation)
        self.shown = set(validation.labels[validation.labels >= 0].tolist())
        self.draws, self.device = draws, self.validation.device
        self.photographs = None
        if photographs is not None:
            self.photographs = CachedSet.of(detector, self.backbone, photographs)
        self.pool: Scene | None = None
        began, self.cpu_begun = time.perf_counter(), time.process_time()
        if pooled(settings, draws, scene.distribution):
            self.pool = pool_of(scene, settings.pool_per_bin, generator)
        synchronise(self.device)
        self.pool_seconds = time.perf_counter() - began
        self._start = params
        if settings.start != "warm":
            warm = {name: value for name, value in params.items() if name.startswith("backbone.")}
            self._start = {**placed(detector.init(generator), self.device), **warm}
        self.objective = Objective(self.validation, validation, settings.objective, settings.smooth)
        self.differentiated = self.objective
        self.images = self.steps = self._numbers = 0
        self.common_numbers = False
        self.trajectory: Trajectory | None = None
        self._evaluated: tuple[Parameters, Outputs] = ({}, (torch.empty(0), torch.empty(0)))

    @property
    def trainable(self) -> Parameters:
        """The trained part of theta."""
        return self.detector.split(self.theta)[1]

    def draw(self, psi: Float[Tensor, "objects K"]) -> RenderedImages:
        """An iteration's training images, without maps where no derivative goes through them."""
        scene, count = self.pool or self.scene, self.settings.images_per_object
        rendered = scene.training_set(psi, count, self._common("images"), self.draws)
        self.images += len(rendered)
        return rendered.without_maps() if isinstance(self.draws, HardDraws) else rendered

    def training_set(self, images: LabelledImages) -> CachedSet:
        """The drawn images, and after them the photographs that train with them, under the backbone."""
        drawn = CachedSet.of(self.detector, self.backbone, images)
        return drawn if self.photographs is None else CachedSet.concatenate([drawn, self.photographs])

    def drawn(self, images: CachedSet) -> int:
        """How many of a training set's images were drawn from p_psi."""
        return len(images) - (0 if self.photographs is None else len(self.photographs))

    def weights(self, images: CachedSet) -> Float[Tensor, "N"]:
        """The images' weights in the training loss, on the CPU: 1 / N, or as photographs and drawn images are mixed."""
        sampling = self._sampling(images)
        return torch.full((len(images),), 1.0 / len(images)) if sampling is None else sampling.weights

    def _sampling(self, images: CachedSet) -> Sampling | None:
        if self.photographs is None:
            return None
        real, batch_size = self.training.real, self.training.batch_size
        return real.sampling(self.drawn(images), len(self.photographs), batch_size)

    def _common(self, purpose: Literal["images", "training"]) -> torch.Generator:
        """A generator of the same random numbers until :meth:`renew`, or of new ones without ``common_numbers``."""
        if not self.common_numbers:
            return self.generator
        return stream(self._numbers, f"common {purpose}", self.generator)

    def renew(self) -> None:
        """Change the common random numbers."""
        self._numbers += 1

    def train(self, images: CachedSet, recording: Recording | None = None) -> float:
        """Train theta on a :meth:`training_set`; returns the last epoch's loss, nan for no epochs.

        With ``recording``, the steps are in ``trajectory``.
        """
        if self.settings.epochs == 0:
            return math.nan
        sampling = self._sampling(images)
        how = self.training.of(self._epochs(len(images), sampling))
        how = replace(how, learning_rate=self.settings.learning_rate)
        # The proximal term replaces weight decay: with both, its Hessian would not be the inner problem's.
        if self.detector.proximal > 0.0:
            how = replace(how, weight_decay=0.0)
        start = self.theta if self.settings.start == "previous" else self._start
        self.theta, history = train_detector(
            self.detector,
            start,
            images,
            self._common("training"),
            how,
            self.warm_start,
            recording,
            sampling,
        )
        self.steps += history.steps
        self.trajectory = history.trajectory
        return history.losses[-1]

    def _epochs(self, images: int, sampling: Sampling | None) -> int:
        """As many as ``outer.epochs`` and ``outer.least_steps`` ask for."""
        if self.settings.start == "previous":
            return self.settings.epochs
        steps = math.ceil(images / self.training.batch_size) if sampling is None else sampling.steps
        return max(self.settings.epochs, math.ceil(self.settings.least_steps / steps))

    @torch.no_grad()
    def loss(self, images: CachedSet) -> float:
        """The training loss of a :meth:`training_set` at theta."""
        weights = self.weights(images).to(self.device)
        rows = torch.arange(len(images), device=self.device).split(32)
        return float(sum(images.losses(self.trainable, part) @ weights[part] for part in rows))

    def validation_loss(self) -> float:
        """L_val at theta."""
        return float(self.objective.of_outputs(self._on_validation()))

    def scores(self) -> Float[Tensor, "classes images"]:
        """Each validation image's contribution to theta's score of each class, more is better."""
        return self.objective.scores(self._on_validation())

    @torch.no_grad()
    def _on_validation(self) -> Outputs:
        """Theta's outputs on the validation images, cached until theta changes."""
        theta, outputs = self._evaluated
        if theta is not self.theta:
            outputs = self.objective.outputs(self.trainable)
            self._evaluated = (self.theta, outputs)
        return outputs
