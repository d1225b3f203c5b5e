"""The training of detectors: its settings, the loop as a LightningModule, and the batches."""

from __future__ import annotations

import itertools
import logging
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import lightning.pytorch as pl
import torch
from annotated_types import Ge
from jaxtyping import Int
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from typing_extensions import override

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.losses import Targets, proximal_loss
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.real import Real, Sampling
from neural_sim.detector.trajectory import AdamW, Recorder, Recording, State, Trajectory
from neural_sim.devices import trainer_on
from neural_sim.ranges import Fraction, NonNegative, Positive, PositiveInt, validated
from neural_sim.types import LabelledImages

Batch = tuple[tuple[Tensor, ...], Targets]


@validated
@dataclass(frozen=True)
class Optimisation:
    """Settings of a detector's training: AdamW with linear warm-up and cosine decay to zero.

    Args:
        epochs, batch_size: these set the number of steps.
        learning_rate: peak of the schedule; 0 leaves the parameters unchanged.
        weight_decay: decoupled weight decay of convolutional and linear weights (not of biases and normalisations).
        warmup_fraction: fraction of the steps over which the learning rate rises.
    """

    epochs: PositiveInt
    batch_size: PositiveInt = 32
    learning_rate: NonNegative = 3e-3
    weight_decay: NonNegative = 1e-4
    warmup_fraction: Fraction = 0.1


class DetectorModule(pl.LightningModule):
    """Trains the parameters ``learned`` on the detector's mean loss.

    Batches are (inputs, targets). Inputs are images (one tensor [n, 3, h, w]) if the backbone is learned, otherwise
    features of the frozen backbone (one tensor for each level).

    Args:
        learned: the parameters that are trained; they are copied.
        fixed: all other parameters; never written to.
        total_steps: optimiser steps until the learning rate reaches zero.
        anchor: anchor of the detector's proximal term, for all learned names; None: no such term.
        recording: which of the steps ``trajectory`` records.

    Raises:
        ValueError: the recording does not fit its memory limit.
    """

    def __init__(
        self,
        detector: Detector,
        learned: Parameters,
        fixed: Parameters,
        how: Optimisation,
        total_steps: int,
        anchor: Parameters | None = None,
        recording: Recording | None = None,
    ) -> None:
        super().__init__()
        self.detector = detector
        self._names = list(learned)
        self._values = nn.ParameterList([nn.Parameter(value.detach().clone()) for value in learned.values()])
        self._anchor = anchor
        self._fixed = {name: value.detach() for name, value in fixed.items()}
        self._on_features = not set(learned) & set(detector.split({**fixed, **learned})[0])
        self.how, self.total_steps = how, total_steps
        self.warmup_steps = math.ceil(how.warmup_fraction * total_steps)
        self.epoch_losses: list[float] = []
        self.steps_done = 0
        self._losses: list[Tensor] = []
        self._sizes: list[int] = []
        self._epochs: list[int] = []
        self._recorder = None
        if recording is not None:
            self._recorder = Recorder(recording, AdamW(self._decay()), total_steps, _flat(self._values))

    def parameters_by_name(self) -> Parameters:
        """Return detached copies of the learned parameters as they are now."""
        return {name: value.detach().clone() for name, value in zip(self._names, self._values, strict=True)}

    def trajectory(self, rows: Sequence[Tensor]) -> Trajectory:
        """Return the record of the steps done so far; ``rows`` are the rows of their batches.

        Raises:
            ValueError: nothing was recorded.
        """
        if self._recorder is None:
            raise ValueError("DetectorModule: want a recording for a trajectory, got None")
        return self._recorder.trajectory(tuple(rows), _flat(self._values))

    @override
    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        inputs, targets = batch
        learned = dict(zip(self._names, self._values, strict=True))
        backbone, trainable = self.detector.split({**self._fixed, **learned})
        features = inputs if self._on_features else self.detector.features(backbone, inputs[0])
        loss = self.detector.per_image_loss(trainable, features, targets).mean()
        self._losses.append(loss.detach())
        self._sizes.append(len(targets))
        if self.detector.proximal == 0.0 or self._anchor is None:
            return loss
        return loss + proximal_loss(learned, self._anchor, self.detector.proximal)

    @override
    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        # Lightning's own method refuses frozen dataclasses.
        inputs, targets = batch
        moved = Targets(targets.labels.to(device), targets.deltas.to(device))
        return tuple(x.to(device) for x in inputs), moved

    @override
    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if self._recorder is None:
            return

        gradients = [value.grad for value in self._values if value.grad is not None]
        if len(gradients) < len(self._names):
            missed = [n for n, value in zip(self._names, self._values, strict=True) if value.grad is None]
            raise ValueError(f"DetectorModule: {missed} have no gradient, so the step cannot be recorded")

        def moment(name: str) -> Tensor:
            # The optimiser has no moments before its first step.
            return _flat(optimizer.state[value].get(name, torch.zeros_like(value)) for value in self._values)

        def state() -> State:
            return _flat(self._values), moment("exp_avg"), moment("exp_avg_sq")

        self._recorder.step(state, lambda: _flat(gradients), optimizer.param_groups[0]["lr"])

    @override
    def on_train_epoch_end(self) -> None:
        self._epochs.append(len(self._sizes) - self.steps_done)
        self.steps_done = len(self._sizes)

    @override
    def on_train_end(self) -> None:
        # One transfer to the host for all losses: a transfer each epoch would stall the device.
        losses = torch.stack(self._losses).cpu().double().split(self._epochs)
        sizes = torch.tensor(self._sizes, dtype=torch.float64).split(self._epochs)
        pairs = zip(losses, sizes, strict=True)
        self.epoch_losses = [float((loss * size).sum() / size.sum()) for loss, size in pairs]

    @override
    def configure_optimizers(self) -> dict:
        decayed = [value for value in self._values if value.ndim > 1]
        others = [value for value in self._values if value.ndim <= 1]
        groups = [
            {"params": decayed, "weight_decay": self.how.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        optimiser = torch.optim.AdamW(groups, lr=self.how.learning_rate, fused=True)
        schedule = LambdaLR(optimiser, self._rate)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def _decay(self) -> Tensor:
        """Return the weight decay of each entry of the learned parameters."""
        decays = [self.how.weight_decay if value.ndim > 1 else 0.0 for value in self._values]
        return torch.cat(
            [
                value.detach().new_full((value.numel(),), decay)
                for value, decay in zip(self._values, decays, strict=True)
            ]
        )

    def _rate(self, step: int) -> float:
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        done = (step - self.warmup_steps) / max(1, self.total_steps - self.warmup_steps)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


def _flat(tensors: Iterable[Tensor]) -> Tensor:
    """Copy all entries into one vector."""
    return torch.cat([tensor.detach().reshape(-1) for tensor in tensors])


@validated
@dataclass(frozen=True)
class Training:
    """Training settings that detectors share, whichever method chose their images.

    Args:
        image_size: side of the square images in pixels.
        images_per_object: number of training images of each object.
        warm_start: distribution of the warm start's images: all parameters uniform, or the initial psi.
        warm_epochs, cold_epochs: epochs of the warm start, and of the detectors that are scored.
        batch_size, learning_rate, weight_decay: see ``Optimisation``.
        real: how training uses labelled photographs.

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
        images: the images, on the device of ``params``. If they are given as features, what follows these is trained,
            otherwise what the detector declares as ``learnable``.
        generator: shuffles the batches.
        how: the optimiser and its budget.
        anchor: theta_0; adds the detector's proximal term over the trained parameters to the loss. None: no such term.
        recording: which of the steps the history keeps (None: none).
        sampling: how batches are drawn from ``images`` (None: each image once in every epoch).

    Returns:
        All parameters (new, detached tensors for the trained ones, the given tensors for the others), and the history,
        whose losses exclude the proximal term.

    Raises:
        ValueError: there are no images, the recording does not fit its memory limit, or the loss stops being finite.
    """
    if len(images) == 0:
        raise ValueError("train_detector: got no images, want at least one")
    backbone, predictor = detector.split(params)
    # In the psi loop, which passes features, all that follows the features is trained.
    names = set(predictor) if isinstance(images, CachedSet) else set(detector.learnable(params))
    if not names & set(backbone) and not isinstance(images, CachedSet):
        images = CachedSet.of(detector, backbone, images)
    if isinstance(images, CachedSet):
        inputs, targets = images.features, images.targets
    else:
        inputs, targets = (images.images,), detector.assign(images.boxes, images.labels)
    learned = {name: value for name, value in params.items() if name in names}
    fixed = {name: value for name, value in params.items() if name not in names}
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
