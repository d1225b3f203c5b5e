"""What labelled photographs in training are worth, in the units of the loop's derivative: how far L_val falls."""

from __future__ import annotations

import copy
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.real import Real
from neural_sim.outer.descent import GradientLoop
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class Labelled:
    """``fall``: how far L_val falls when so many ``photographs`` train beside the images of the initial distribution,
    with its standard error over trainings (None: of one).
    """

    photographs: int
    fall: float
    error: float | None


def labelled_gains(
    loop: GradientLoop, photographs: LabelledImages, counts: Sequence[int], trials: int, seed: int
) -> list[Labelled]:
    """Train as the loop does at its psi, without photographs and with each of ``counts``; psi does not move.

    Photographs are half of every batch, drawn again and again. The trainings of a trial have the same random numbers,
    so that their differences are due to photographs alone. Counts above the number of photographs are that number.

    Raises:
        ValueError: no trial, or a count below 1.
    """
    if trials < 1 or min(counts, default=1) < 1:
        raise ValueError(f"want trials >= 1 and counts of at least 1, got {trials}, {list(counts)}")
    known = sorted({min(count, len(photographs)) for count in counts})
    losses: dict[int, list[float]] = {count: [] for count in (0, *known)}
    numbered = copy.copy(loop.inner)
    numbered.common_numbers, numbered.photographs = True, None
    for _ in range(trials):
        for count, values in losses.items():
            inner = copy.copy(numbered)
            if count:
                real = Real("combined", count=count)
                chosen = real.chosen(photographs, seed).to(inner.device)
                inner.training = replace(inner.training, real=real)
                inner.photographs = CachedSet.of(inner.detector, inner.backbone, chosen)
            inner.train(inner.training_set(inner.draw(loop.psi).images))
            values.append(inner.validation_loss())
        numbered.renew()
    return [_gain(count, losses[0], losses[count]) for count in known]


def _gain(count: int, without: Sequence[float], with_them: Sequence[float]) -> Labelled:
    falls = [a - b for a, b in zip(without, with_them, strict=True)]
    error = statistics.stdev(falls) / math.sqrt(len(falls)) if len(falls) > 1 else None
    return Labelled(count, statistics.fmean(falls), error)


def equivalent(gains: Sequence[Labelled], fall: float) -> float | None:
    """The number of photographs that L_val falls by so much with, linear in between; None: more than were tried."""
    before = Labelled(0, 0.0, None)
    for gain in sorted(gains, key=lambda g: g.photographs):
        if gain.fall >= fall:
            part = (fall - before.fall) / (gain.fall - before.fall)
            return before.photographs + part * (gain.photographs - before.photographs)
        before = gain
    return None
