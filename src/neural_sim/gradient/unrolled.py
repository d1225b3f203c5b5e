"""The hypergradient of the training that was actually run.

``gradient.reversal`` reverses its steps. Estimators read sums over these steps: scores of images and probes, and
derivatives with respect to the training's inputs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.detector.real import shuffled_passes
from neural_sim.detector.trajectory import Recording
from neural_sim.gradient.base import IndexedLoss, MixedDerivative
from neural_sim.gradient.hypergradient import Hypergradient, UnrolledAdjoint
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.reversal import (
    InputsOf,
    Product,
    RecordedTraining,
    ReversedStep,
    Wanted,
    reversed_steps,
)
from neural_sim.ranges import (
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    validated,
)
from neural_sim.solver.hvp import Term, gradient
from neural_sim.solver.operator import norm


@dataclass(frozen=True)
class Accumulated:
    """Sums over the reversed steps; for a_t see ``gradient.reversal``.

    Attributes:
        images: derivatives of L_val by the training images' weights, with which each image counts in the mean over its
            batch (1 in the training that was run); empty unless wanted.
        inputs: derivatives with respect to the training images' inputs; empty unless wanted.
        probes: each probe's score, estimated from the steps that scored it. The mean over the probes of a bin is
            unbiased for ``sum_t f_t mean_i <dl_i/dtheta, a_t>``, up to an offset common to all bins of a group; f_t is
            the fraction of step t's batch that was drawn from p_psi.
        scored: number of pairs of a probe and a step that were scored.
        inputs_of: computes the inputs from images and their rows.
    """

    images: Float[Tensor, "N"]
    inputs: tuple[Tensor, ...]
    probes: Float[Tensor, "m"]
    scored: int
    inputs_of: InputsOf | None = None

    def cotangents(
        self, images: Float[Tensor, "n 3 h w"], index: Int[Tensor, "n"], chunk_size: int = 16
    ) -> Float[Tensor, "n 3 h w"]:
        """Compute derivatives of L_val by the pixels of images: the vector-Jacobian product of ``inputs_of``.

        ``images`` belong to the rows ``index``; ``chunk_size`` of them are differentiated at a time.

        Raises:
            ValueError: derivatives with respect to the inputs were not accumulated.
        """
        if not self.inputs or self.inputs_of is None:
            raise ValueError(
                "unrolled: want the derivative with respect to the inputs, which was not accumulated"
            )
        parts: list[Tensor] = []
        for rows, chunk in zip(torch.split(index, chunk_size), torch.split(images, chunk_size), strict=True):
            rows = rows.to(self.inputs[0].device)
            leaf = chunk.detach().requires_grad_()
            with torch.enable_grad():
                inputs = self.inputs_of(leaf, rows)
            # Box targets do not depend on the image, and have no gradient.
            moved = [
                (x, pulled[rows]) for x, pulled in zip(inputs, self.inputs, strict=True) if x.requires_grad
            ]
            values, pulled = zip(*moved, strict=True)
            parts.append(torch.autograd.grad(values, leaf, pulled, materialize_grads=True)[0])
        return torch.cat(parts)


@dataclass(frozen=True)
class ProbeGroups:
    """The probes; each step scores a sample of them.

    Attributes:
        losses: losses of probes by row.
        groups: tables [strata, per_bin] of rows. Each table holds one object's probes of one factor: its rows are bins
            or lights, its columns scenes. All tables have the same number of columns.

    Raises:
        ValueError: a table is not two-dimensional or has no column, or numbers of columns differ.
    """

    losses: IndexedLoss
    groups: Sequence[Int[Tensor, "_ per_bin"]]

    def __post_init__(self) -> None:
        widths = {table.shape[-1] for table in self.groups}
        if len(widths) != 1 or 0 in widths or any(table.ndim != 2 for table in self.groups):
            shapes = [tuple(table.shape) for table in self.groups]
            raise ValueError(f"probes: want tables [strata, per_bin] of the same per_bin >= 1, got {shapes}")

    @property
    def per_bin(self) -> int:
        """Number of columns of every table."""
        return self.groups[0].shape[-1]

    @property
    def count(self) -> int:
        """One more than the largest row of any group."""
        return 1 + max(int(table.max()) for table in self.groups)


@validated
@dataclass(frozen=True)
class Unrolled:
    """``outer.adjoint``: the derivative of the training that was run.

    Args:
        product: how a batch's Hessian is multiplied, see ``gradient.reversal.reversed_steps``.
        max_memory_mb: memory limit of the recorded training, see ``detector.trajectory.Recording``.
        probes_per_step: number of probes of every bin that a step scores, in shuffled passes over all of them; 0: all.
            At 1, most of a derivative's variance comes from the choice of probes and of validation images
            (docs/numerics.md, Noise of a derivative).
        scored_steps: number of steps up to which all of them score probes; 0: all steps do in any training. A longer
            training is divided into blocks. In each block one random step scores probes, with the block's weight, see
            ``step_weights``. The number of blocks grows slowly: it is 1.6 times ``scored_steps`` at 5 times the steps,
            and 2.2 times at 20 times. More objects mean more probes and more steps: if every step scored probes, the
            cost would grow with the square of the number of objects.
        chunk_size: number of probes whose losses are computed at a time.
        floor: smallest denominator allowed for an entry of theta in AdamW's steps, as a fraction of what is usual for
            the entry and its tensor, see ``detector.trajectory.AdamW.floored``; 0 is exact.
    """

    product: Product = "forward_difference"
    max_memory_mb: Positive = 2048.0
    probes_per_step: NonNegativeInt = 1
    scored_steps: NonNegativeInt = 60
    chunk_size: PositiveInt = 64
    floor: NonNegative = 0.3

    @property
    def recording(self) -> Recording:
        """How the training is recorded."""
        return Recording(self.max_memory_mb)

    def doubts(self, adjoint: UnrolledAdjoint) -> list[str]:
        """Name the conditions that a reversed training fails: ``solver`` if it is not ``finite``."""
        return [] if adjoint.finite else ["solver"]

    def derivative(
        self,
        training: RecordedTraining,
        validation: Sequence[Term],
        estimates: Mapping[str, Estimate],
        generator: torch.Generator,
        wanted: Wanted = "weights",
        probes: ProbeGroups | None = None,
    ) -> Hypergradient[UnrolledAdjoint]:
        """Compute the derivative of L_val through a training, for every object.

        Args:
            training: the training.
            validation: the terms of L_val as functions of the parameters.
            estimates: by object, its estimator as a function of the sums over the steps.
            generator: source of the random numbers that choose steps and probes.
            wanted: which sums the estimators read.
            probes: the probes that the steps score.
        """
        began = time.perf_counter()
        slope = gradient(validation, training.params)
        validated = time.perf_counter()
        sums = self.accumulate(training, slope, generator, wanted, probes)
        walked = time.perf_counter()
        parts = {name: estimate(sums) for name, estimate in estimates.items()}
        finite = bool(sums.images.isfinite().all() and sums.probes.isfinite().all())
        return Hypergradient(
            gradients={name: part.value for name, part in parts.items()},
            errors={name: part.standard_error for name, part in parts.items()},
            p_values={name: part.p_values for name, part in parts.items()},
            seconds={
                "validation": validated - began,
                "unrolled": walked - validated,
                "mixed": time.perf_counter() - walked,
            },
            adjoint=UnrolledAdjoint(training.steps, finite, norm(slope)),
        )

    def accumulate(
        self,
        training: RecordedTraining,
        slope: Float[Tensor, "n"],
        generator: torch.Generator,
        wanted: Wanted = "weights",
        probes: ProbeGroups | None = None,
    ) -> Accumulated:
        """Reverse a training from ``slope``, ``dL_val/dtheta`` after its last step; see ``derivative``."""
        examples = training.examples
        steps = reversed_steps(training, slope, self.product, wanted, self.floor)
        scoring = None if probes is None else _Scoring(probes, slope, self.chunk_size)
        per_bin = probes.per_bin if probes else 1
        columns = shuffled_passes(per_bin, min(self.probes_per_step or per_bin, per_bin), generator)
        every = math.ceil(training.steps / self.scored_steps) if self.scored_steps else 1
        weights = step_weights(training.steps, every, generator)
        images = slope.new_zeros(0 if wanted == "probes" else len(examples.inputs[0]))
        inputs = tuple(torch.zeros_like(values) for values in examples.inputs) if wanted == "inputs" else ()
        for step in steps:
            if wanted != "probes":
                images.index_add_(0, step.rows, step.scores / len(step.rows))
            for into, part in zip(inputs, step.inputs, strict=True):
                into.index_add_(0, step.rows, part)
            if scoring is not None and (weight := next(weights)):
                scoring.add(step, next(columns), weight * examples.drawn_part(step.rows))
        total, scored = (slope.new_zeros(0), 0) if scoring is None else (scoring.total, scoring.scored)
        return Accumulated(images, inputs, total, scored, examples.inputs_of)


Estimate = Callable[[Accumulated], MixedDerivative]
"""Computes one object's derivative from the sums over the steps."""


class _Scoring:
    """Running sums of the probes' scores."""

    def __init__(self, probes: ProbeGroups, like: Tensor, chunk_size: int) -> None:
        self.losses, self.per_bin, self.chunk_size = probes.losses, probes.per_bin, chunk_size
        self.tables = [table.to(like.device) for table in probes.groups]
        self.total, self.scored = like.new_zeros(probes.count), 0
        self._levels: list[Tensor] = []

    def add(self, step: ReversedStep, chosen: Int[Tensor, "columns"], weight: Tensor | float) -> None:
        """Add one step's scores of the probes in some columns, scaled to all columns and ``weight`` steps."""
        columns = chosen.to(self.total.device)
        rows = [table[:, columns].reshape(-1) for table in self.tables]
        along = scores(
            self.losses, step.params, step.along, torch.cat(rows), self.chunk_size, "central_difference"
        )
        parts = torch.split(along, [part.numel() for part in rows])
        means = [part.mean() for part in parts]
        scale = weight * self.per_bin / len(columns)
        # An offset common to a group has no effect, but it adds noise if probes are scored unequally often. It is
        # estimated from the previous scored step, because the mean of these same scores would correlate with their
        # noise; only the first scored step uses its own mean.
        for into, part, level in zip(rows, parts, self._levels or means, strict=True):
            self.total.index_add_(0, into, scale * (part - level))
        self._levels, self.scored = means, self.scored + len(along)


def step_weights(steps: int, every: int, generator: torch.Generator) -> Iterator[int]:
    """Yield each step's weight, from the last step to the first.

    In each block one random step has the block's length as its weight and the others have 0. Blocks are 1 to
    ``2 every - 1`` steps long, and longer late in the training, where scores scatter less.
    """
    left = steps
    while left:
        block = min(left, 1 + (2 * every - 1) * (left - 1) // steps)
        chosen = int(torch.randint(block, (), generator=generator))
        yield from (block if step == chosen else 0 for step in range(block))
        left -= block
