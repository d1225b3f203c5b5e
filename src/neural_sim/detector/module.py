"""The detector's training loop as a LightningModule, over all parameters or any part of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import lightning.pytorch as pl
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from typing_extensions import override

from neural_sim.detector.losses import Targets, proximal_loss
from neural_sim.detector.optimiser import AdamW, State
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.trajectory import Recorder, Recording, Trajectory
from neural_sim.ranges import Fraction, NonNegative, PositiveInt, validated

Batch = tuple[tuple[Tensor, ...], Targets]


@validated
@dataclass(frozen=True)
class Optimisation:
    """Settings of a detector's training: AdamW with linear warm-up and cosine decay to zero.

    Args:
        epochs, batch_size: these set the number of steps.
        learning_rate: peak of the schedule; 0 leaves the parameters unchanged.
        weight_decay: decoupled weight decay of convolution weights (not of biases and normalisations).
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
            raise ValueError(f"DetectorModule: no gradient, and so no step to record, of {missed}")

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
