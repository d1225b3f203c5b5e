"""A training as pure functions of flat vectors, and its record, so that it can be differentiated in reverse.

A state is theta followed by the optimiser's buffers. A step consists of elementwise torch operations, which autograd
can differentiate. The record has the batches, learning rates and gradients of the steps, and the states before some of
them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.ranges import Positive, validated

logger = logging.getLogger(__name__)
State = tuple[Tensor, ...]
GradientAt = Callable[[Tensor, Tensor], Tensor]
MEGABYTE = 2**20


@dataclass(frozen=True)
class AdamW:
    """Adam with decoupled weight decay (Loshchilov and Hutter 2019, Algorithm 2).

    It steps as ``torch.optim.AdamW`` does. ``weight_decay`` is one number, or one for each entry of theta. The buffers
    are the two moments. ``floor`` is a lower bound of the denominator: one number, or one for each entry.
    """

    weight_decay: float | Float[Tensor, "n"] = 1e-2
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    floor: float | Float[Tensor, "n"] = 0.0

    def begin(self, theta: Float[Tensor, "n"]) -> State:
        """Return the state before the first step."""
        return theta, torch.zeros_like(theta), torch.zeros_like(theta)

    def step(self, state: State, gradient: Float[Tensor, "n"], rate: float, done: int) -> State:
        """Return the state after the next step; ``done`` steps came before it."""
        theta, first, second = state
        fast, slow = self.betas
        first = fast * first + (1.0 - fast) * gradient
        second = slow * second + (1.0 - slow) * gradient.square()
        corrected, spread = first / (1.0 - fast ** (done + 1)), second / (1.0 - slow ** (done + 1))
        denominator = (_root(spread) + self.eps).clamp_min(self.floor)
        theta = (1.0 - rate * self.weight_decay) * theta - rate * corrected / denominator
        return theta, first, second

    def floored(self, end: State, done: int, fraction: float, sizes: Sequence[int]) -> AdamW:
        """Return the rule to differentiate in place of this one, after ``done`` steps that ended in ``end``.

        It bounds the denominator from below by ``fraction`` times the larger of two numbers: the entry's denominator in
        the last step, and the root mean square of the denominators in its tensor. A ``fraction`` of 0 leaves the rule
        unchanged. ``sizes`` are the numbers of entries of theta's tensors, in order.

        While an entry's gradients are tiny (a level of the pyramid before the first batch with an object of its size),
        a step is the ratio of the moments, whatever their size, and its derivative is about 1 / |g|: thousands of times
        that of other entries. But a finite change of the batch's images produces a gradient of normal size, which moves
        the moments too, and changes the step by no more than the learning rate. The last step's second moment averages
        over the whole training and shows that normal size. If the entry's gradients stay tiny to the end (a class's
        weight on a channel that is dark in all images of the present distribution), the other entries of its tensor
        show what is normal.
        """
        if fraction == 0.0:
            return self
        usual = _root(end[2] / (1.0 - self.betas[1] ** done)) + self.eps
        levels = [part.square().mean().sqrt().expand(len(part)) for part in usual.split(list(sizes))]
        return replace(self, floor=fraction * torch.maximum(usual, torch.cat(levels)))


def pulled_back(
    rule: AdamW,
    state: State,
    gradient: Float[Tensor, "n"],
    rate: float,
    done: int,
    cotangents: Sequence[Tensor],
) -> tuple[list[Tensor], Float[Tensor, "n"]]:
    """Pull cotangents of a step's result back onto its state, and onto its gradient.

    The caller adds the dependence of the gradient on theta: the batch's Hessian times the second result.
    """
    leaves = [part.detach().requires_grad_() for part in (*state, gradient)]
    with torch.enable_grad():
        stepped = rule.step(tuple(leaves[:-1]), leaves[-1], rate, done)
    *earlier, along = torch.autograd.grad(stepped, leaves, list(cotangents), materialize_grads=True)
    return earlier, along


def _root(values: Tensor) -> Tensor:
    """Take the square root with derivative 0, not infinity, at 0, where an entry has had no gradient so far."""
    positive = values > 0.0
    return torch.where(positive, values, 1.0).sqrt() * positive


@validated
@dataclass(frozen=True)
class Recording:
    """How a training is recorded.

    Args:
        max_memory_mb: limit in MB. The record has the states of every sqrt(steps)-th step and all gradients; the states
            in between are recomputed elementwise. If the gradients do not fit, they are recomputed, at the cost of one
            more training.
    """

    max_memory_mb: Positive = 2048.0

    def keeps_gradients(self, steps: int, state_bytes: int, vector_bytes: int) -> bool:
        """Tell whether the gradients of all steps fit into the limit together with the states.

        Raises:
            ValueError: not even the states fit.
        """
        length = segment_length(steps)
        # States at the first step of each segment, plus one segment's states and gradients while it is reversed.
        least = (math.ceil(steps / length) + length) * state_bytes + length * vector_bytes
        if least > self.max_memory_mb * MEGABYTE:
            raise ValueError(
                f"outer.adjoint.max_memory_mb: {steps} steps take {least / MEGABYTE:.0f} MB at least, got "
                f"{self.max_memory_mb:g}"
            )
        return least + steps * vector_bytes <= self.max_memory_mb * MEGABYTE


@dataclass(frozen=True)
class Trajectory:
    """A recorded training. Vectors are flat, in the order of the learned parameters.

    ``rows`` are each step's batch, as rows of the training set; the step's gradient is that of the batch's mean loss
    (plus the proximal term). ``rates`` are the learning rates. ``checkpoints`` are the states before some steps;
    ``gradients`` are those of all steps, or empty. ``end`` is theta after the last step.
    """

    rule: AdamW
    rows: tuple[Int[Tensor, "_"], ...]
    rates: tuple[float, ...]
    checkpoints: Mapping[int, State]
    gradients: Mapping[int, Float[Tensor, "n"]]
    end: Float[Tensor, "n"]

    def __post_init__(self) -> None:
        steps = len(self.rows)
        if steps == 0 or len(self.rates) != steps:
            raise ValueError(
                f"trajectory: want a learning rate for each of 1 or more steps, got {len(self.rates)} for {steps}"
            )
        if not self.checkpoints or not all(0 <= step < steps for step in self.checkpoints):
            raise ValueError(
                f"trajectory: want checkpoints at steps in [0, {steps}), got {sorted(self.checkpoints)}"
            )

    def __len__(self) -> int:
        return len(self.rows)

    def segments(self) -> list[range]:
        """Return the ranges of steps between checkpoints, the last range first."""
        starts = sorted(self.checkpoints)
        ends = [*starts[1:], len(self)]
        return [range(begin, end) for begin, end in zip(starts, ends, strict=True)][::-1]

    def replayed(self, segment: range, gradient_at: GradientAt) -> list[tuple[State, Float[Tensor, "n"]]]:
        """Return the state before each step of a segment, and its gradient: recorded, or from ``gradient_at``."""
        replayed, state = [], self.checkpoints[segment.start]
        for step in segment:
            gradient = self.gradients.get(step)
            if gradient is None:
                gradient = gradient_at(state[0], self.rows[step])
            replayed.append((state, gradient))
            if step + 1 < segment.stop:
                state = self.rule.step(state, gradient, self.rates[step], step)
        return replayed


def segment_length(steps: int) -> int:
    """Return the distance between checkpoints that minimises the memory of all of them and one segment's states."""
    return max(1, math.isqrt(max(0, steps - 1)) + 1)


class Recorder:
    """Records the steps of one training.

    Args:
        recording: how it is recorded.
        rule: the optimiser.
        steps: number of steps of the training.
        theta: the parameters, for their size and type.

    Raises:
        ValueError: the states do not fit ``recording.max_memory_mb``.
    """

    def __init__(self, recording: Recording, rule: AdamW, steps: int, theta: Float[Tensor, "n"]) -> None:
        self.rule = rule
        self._length = segment_length(steps)
        self._rates: list[float] = []
        self._checkpoints: dict[int, State] = {}
        self._gradients: dict[int, Tensor] = {}
        vector = theta.numel() * theta.element_size()
        self._keeps_gradients = recording.keeps_gradients(steps, len(rule.begin(theta)) * vector, vector)
        if not self._keeps_gradients:
            logger.info("unrolled: gradients do not fit %g MB and are recomputed", recording.max_memory_mb)

    def step(self, state: Callable[[], State], gradient: Callable[[], Tensor], rate: float) -> None:
        """Record a step before it is taken. ``state`` and ``gradient`` return copies and are called only if needed."""
        number = len(self._rates)
        self._rates.append(rate)
        if number % self._length == 0:
            self._checkpoints[number] = state()
        if self._keeps_gradients:
            self._gradients[number] = gradient()

    def trajectory(self, rows: tuple[Int[Tensor, "_"], ...], end: Float[Tensor, "n"]) -> Trajectory:
        """Return the recorded training; ``rows`` are its batches and ``end`` is theta after the last step."""
        return Trajectory(self.rule, rows, tuple(self._rates), self._checkpoints, self._gradients, end)


def train(
    rule: AdamW,
    theta: Float[Tensor, "n"],
    rows: tuple[Int[Tensor, "_"], ...],
    rates: tuple[float, ...],
    gradient_at: GradientAt,
    recording: Recording = Recording(),
) -> Trajectory:
    """Train from ``theta`` on these batches with these learning rates, without a Trainer, and record it."""
    recorder = Recorder(recording, rule, len(rows), theta)
    state = rule.begin(theta)
    for done, (batch, rate) in enumerate(zip(rows, rates, strict=True)):
        gradient = gradient_at(state[0], batch)
        recorder.step(lambda value=state: value, lambda value=gradient: value, rate)
        state = rule.step(state, gradient, rate, done)
    return recorder.trajectory(rows, state[0])
