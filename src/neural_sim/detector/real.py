"""Labelled photographs in training: which ones are used, and in what proportion to synthetic images."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import torch
from annotated_types import Gt, Lt
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.randomness import stream
from neural_sim.ranges import NonNegativeInt, Positive, PositiveFraction, validated
from neural_sim.types import LabelledImages

_log = logging.getLogger(__name__)

Mode = Literal["none", "combined", "pretrain"]
Fewer = Literal["refuse", "all"]


@validated
@dataclass(frozen=True)
class Real:
    """How training uses labelled photographs (the target's training set).

    Args:
        mode: ``combined``: every training (warm start, psi loop, scored detectors) uses synthetic images and
            photographs. ``pretrain``: scored detectors are trained on synthetic images and then fine-tuned on
            photographs; the warm start and the psi loop see synthetic images only. ``none``: no photographs.
        count: number of photographs; 0 means ``none``. A smaller count takes some of those that a larger one takes.
        fraction: fraction of the photographs, instead of ``count``. Without either, all of them are used.
        batch_fraction: for ``combined``: fraction of photographs in every batch, drawn repeatedly; there are as many
            steps as without them. None: photographs are used like all other images, once in every epoch.
        finetune: for ``pretrain``: number of steps on photographs, as a fraction of those on synthetic images.
        finetune_learning_rate: peak learning rate of these steps.
        fewer: what to do if there are fewer photographs than ``count``: ``refuse``, or take ``all`` of them with
            a warning.

    Raises:
        ValueError: both ``count`` and ``fraction`` are given.
    """

    mode: Mode = "none"
    count: NonNegativeInt | None = None
    fraction: PositiveFraction | None = None
    batch_fraction: Annotated[float, Gt(0), Lt(1)] | None = 0.5
    finetune: Positive = 0.3
    finetune_learning_rate: Positive = 1e-3
    fewer: Fewer = "refuse"

    def __post_init__(self) -> None:
        if self.count is not None and self.fraction is not None:
            raise ValueError(f"want count or fraction, got both, {self.count} and {self.fraction}")

    @property
    def used(self) -> bool:
        """True if photographs are used."""
        return self.mode != "none" and self.count != 0

    @property
    def combined(self) -> bool:
        """True if photographs are mixed with synthetic images."""
        return self.used and self.mode == "combined"

    def number(self, available: int) -> int:
        """Return how many of ``available`` photographs are used.

        Raises:
            ValueError: there are fewer photographs than ``count`` and that is refused, or none at all.
        """
        count = available if self.count is None else self.count
        if self.fraction is not None:
            count = max(1, round(self.fraction * available))
        elif self.fewer == "all" and 0 < available < count:
            _log.warning("training.real: %d photographs instead of %d: there are no more", available, count)
            count = available
        if not 0 < count <= available:
            raise ValueError(
                f"training.real: want {max(1, count)} photographs or more to train on, got {available}"
            )
        return count

    def of(self, available: int) -> Real:
        """Return equivalent settings with an explicit ``count``, so that equal trainings have equal keys.

        Raises:
            ValueError: as for ``number``.
        """
        return replace(self, count=self.number(available), fraction=None, fewer="refuse")

    def chosen(self, photographs: LabelledImages | None, seed: int) -> LabelledImages:
        """Choose the photographs to train on: the first ones in a random order that depends only on ``seed``.

        Raises:
            ValueError: as for ``number``.
        """
        available = 0 if photographs is None else len(photographs)
        count = self.number(available)
        assert photographs is not None  # ``number`` found at least one
        return photographs.select(torch.randperm(available, generator=stream(seed, "photographs"))[:count])

    def sampling(self, synthetic: int, photographs: int, batch_size: int) -> Sampling | None:
        """Return how batches are drawn from ``synthetic`` images followed by ``photographs``; None: all alike."""
        if self.batch_fraction is None:
            return None
        real = min(max(1, round(self.batch_fraction * batch_size)), batch_size - 1)
        steps = -(-synthetic // batch_size)
        return Sampling((synthetic, photographs), (batch_size - real, real), steps)


@dataclass(frozen=True)
class Sampling:
    """Batches with a fixed number of images from each pool, in shuffled passes over the pool.

    Args:
        pools: sizes of the pools, which are consecutive rows of a training set.
        per_batch: number of images from each pool in every batch.
        steps: number of batches in an epoch.

    Raises:
        ValueError: a number is below 1, or the lengths differ.
    """

    pools: tuple[int, ...]
    per_batch: tuple[int, ...]
    steps: int

    def __post_init__(self) -> None:
        if len(self.pools) != len(self.per_batch) or min((*self.pools, *self.per_batch, self.steps)) < 1:
            raise ValueError(
                "sampling: want at least one image of each pool in a batch and one step, got "
                f"{self.per_batch} of {self.pools} in {self.steps} steps"
            )

    def batches(self, generator: torch.Generator) -> Iterator[Int[Tensor, "batch"]]:
        """Yield the rows of one batch after another, endlessly."""
        starts = [sum(self.pools[:place]) for place in range(len(self.pools))]
        pools = zip(self.pools, self.per_batch, strict=True)
        drawn = [shuffled_passes(size, count, generator) for size, count in pools]
        while True:
            yield torch.cat([start + next(rows) for start, rows in zip(starts, drawn, strict=True)])

    @property
    def weights(self) -> Float[Tensor, "N"]:
        """The images' weights in a batch's mean loss, averaged over batches; they sum to 1."""
        total = sum(self.per_batch)
        pools = zip(self.pools, self.per_batch, strict=True)
        return torch.cat([torch.full((size,), count / (total * size)) for size, count in pools])


def shuffled_passes(
    size: int, per_batch: int, generator: torch.Generator
) -> Iterator[Int[Tensor, "per_batch"]]:
    """Yield ``per_batch`` of the numbers below ``size`` at a time, from shuffled passes over all of them.

    Each number is equally likely in every batch.
    """
    remaining = torch.zeros(0, dtype=torch.long)
    while True:
        while len(remaining) < per_batch:
            remaining = torch.cat([remaining, torch.randperm(size, generator=generator)])
        yield remaining[:per_batch]
        remaining = remaining[per_batch:]
