"""Train a detector for a fixed budget of steps."""

from __future__ import annotations

import itertools
import logging
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from jaxtyping import Int
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.losses import Targets
from neural_sim.detector.module import Batch, DetectorModule, Optimisation
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.real import Real, Sampling
from neural_sim.detector.trajectory import Recording, Trajectory
from neural_sim.devices import trainer_on
from neural_sim.ranges import NonNegative, Positive, PositiveInt, validated
from neural_sim.types import LabelledImages


@validated
@dataclass(frozen=True)
class Training:
    """Training settings that detectors share, whichever method chose their images.

    ``image_size`` is the side of the square images in pixels. ``images_per_object`` is the number of training images of
    each object. ``warm_start`` is the distribution of the warm start's images: all parameters uniform, or the initial
    psi. ``warm_epochs`` are the epochs of the warm start, ``cold_epochs`` those of the detectors that are scored.
    ``real`` says how training uses labelled photographs. For the rest see ``Optimisation``.

    Raises:
        ValueError: batches of one image cannot mix photographs with synthetic images.
    """

    image_size: Annotated[int, Ge(16)] = 96
    images_per_object: PositiveInt = 100
    warm_start: Literal["uniform", "initial"] = "uniform"
    warm_epochs: PositiveInt = 30
    cold_epochs: PositiveInt = 30
    batch_size: PositiveInt = 32
    learning_rate: Positive = 3e-3
    weight_decay: NonNegative = 1e-4
    real: Real = field(default_factory=Real)

    def __post_init__(self) -> None:
        if self.real.combined and self.real.batch_fraction is not None and self.batch_size < 2:
            raise ValueError(
                f"Training.batch_size: want at least 2, a photograph and a synthetic image, got {self.batch_size}"
            )

    def of(self, epochs: int) -> Optimisation:
        """Return the settings of a training with this many epochs."""
        return Optimisation(epochs, self.batch_size, self.learning_rate, self.weight_decay)


@dataclass(frozen=True)
class TrainingHistory:
    """The course of a training.

    Attributes:
        losses: mean training loss of each epoch, as seen by the steps.
        steps: optimiser steps done.
        trajectory: the steps themselves, if they were recorded.
    """

    losses: tuple[float, ...]
    steps: int
    trajectory: Trajectory | None = field(default=None, compare=False)


class Batches:
    """Batches of inputs and targets, shuffled by the generator in each epoch, or drawn as ``sampling`` says.

    ``drawn`` collects the rows of every batch so far.

    Raises:
        ValueError: the sampling is for another number of images.
    """

    def __init__(
        self,
        inputs: tuple[Tensor, ...],
        targets: Targets,
        batch_size: int,
        generator: torch.Generator,
        sampling: Sampling | None = None,
    ) -> None:
        if sampling is not None and sum(sampling.pools) != len(targets):
            raise ValueError(f"batches: want {sum(sampling.pools)} images, got {len(targets)}")
        self.inputs, self.targets, self.batch_size, self.generator = inputs, targets, batch_size, generator
        self._steps = sampling.steps if sampling else -(-len(targets) // batch_size)
        self._sampled = None if sampling is None else sampling.batches(generator)
        self.drawn: list[Tensor] = []

    def __len__(self) -> int:
        return self._steps

    def __iter__(self) -> Iterator[Batch]:
        for index in self._epoch():
            self.drawn.append(index)
            yield tuple(x[index] for x in self.inputs), self.targets.select(index)

    def _epoch(self) -> Iterable[Int[Tensor, "batch"]]:
        # One transfer per epoch, so that the host does not wait for the device at every batch.
        device = self.targets.labels.device
        if self._sampled is not None:
            return torch.stack(list(itertools.islice(self._sampled, self._steps))).to(device)
        order = torch.randperm(len(self.targets), generator=self.generator, device=self.generator.device)
        return order.to(device).split(self.batch_size)


def train_detector(
    detector: Detector,
    params: Parameters,
    images: LabelledImages | CachedSet,
    generator: torch.Generator,
    how: Optimisation,
    anchor: Parameters | None = None,
    recording: Recording | None = None,
    sampling: Sampling | None = None,
) -> tuple[Parameters, TrainingHistory]:
    """Train from ``params``, which are not changed.

    Args:
        detector: the detector.
        params: the initial parameters.
        generator: shuffles the batches.
        how: the optimiser and its budget.
        images: the images, on the device of ``params``. If they are given as features, or the detector freezes its
            backbone, only the pyramid and the head are trained.
        anchor: theta_0; adds the detector's proximal term over the trained parameters to the loss. None: no such term.
        recording: which of the steps the history keeps (None: none).
        sampling: how batches are drawn from ``images`` (None: each image once in every epoch).

    Returns:
        All parameters (new, detached tensors for the trained ones, the given tensors for the frozen ones), and the
        history, whose losses exclude the proximal term.

    Raises:
        ValueError: there are no images, the recording does not fit its memory limit, or the loss stops being finite.
    """
    if len(images) == 0:
        raise ValueError("train_detector: got no images, want at least one")
    fixed, learned = detector.split(params)
    names = set(detector.learnable(params))
    if not names & set(fixed) and not isinstance(images, CachedSet):
        images = CachedSet.of(detector, fixed, images)
    if isinstance(images, CachedSet):
        inputs, targets = images.features, images.targets
    else:
        learned = {name: value for name, value in params.items() if name in names}
        fixed = {name: value for name, value in params.items() if name not in names}
        inputs, targets = (images.images,), detector.assign(images.boxes, images.labels)
    batches = Batches(inputs, targets, how.batch_size, generator, sampling)
    module = DetectorModule(detector, learned, fixed, how, how.epochs * len(batches), anchor, recording)
    _fit(module, batches, next(iter(learned.values())).device)
    _check_finite(module.epoch_losses, how)
    values = {**fixed, **module.parameters_by_name()}
    trajectory = module.trajectory(batches.drawn) if recording else None
    history = TrainingHistory(tuple(module.epoch_losses), module.steps_done, trajectory)
    return {name: values[name] for name in params}, history


def _check_finite(losses: Sequence[float], how: Optimisation) -> None:
    """Refuse a diverged training, whose parameters are NaN and would silently detect nothing."""
    for epoch, loss in enumerate(losses, 1):
        if not math.isfinite(loss):
            raise ValueError(
                f"detector: the training loss is {loss} in epoch {epoch} of {how.epochs}, at a learning rate of "
                f"{how.learning_rate:g}: want a smaller training.learning_rate, or in the psi loop outer.learning_rate"
            )


def _fit(module: DetectorModule, batches: Batches, device: torch.device) -> None:
    """Run Lightning's loop without files or messages."""
    talker = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    level = talker.level
    talker.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="lightning")
            trainer_on(device, module.how.epochs).fit(module, batches)
    finally:
        talker.setLevel(level)
