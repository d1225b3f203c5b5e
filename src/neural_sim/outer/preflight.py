"""Predict, to first order, what steps of psi would gain, and measure what labelled photographs gain."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.real import Real
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.evidence import Average
from neural_sim.outer.steps import slopes_by_p, stacked
from neural_sim.outer.trust_region import TrustRegion, step_within
from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class ExpectedGains:
    """The expected fall of L_val, to first order, if one factor of one object's psi moves.

    Attributes:
        name: the object.
        factor: the factor of psi.
        p_value: p-value of the null hypothesis that the derivative is zero.
        moved: fraction of the object's images that moves to a bin.
        by_bin: fall of L_val if they move to each bin (or light) from all bins, in proportion to their p; None for
            closed bins, to which no image can move.
        by_bin_error: standard errors of ``by_bin``; None for closed bins.
        step: fall of L_val from a step of the loop along the derivative.
        step_error: standard error of ``step``.
    """

    name: str
    factor: str
    p_value: float
    moved: float
    by_bin: tuple[float | None, ...]
    by_bin_error: tuple[float | None, ...]
    step: float
    step_error: float


def expected_gains(loop: GradientLoop, trials: int, moved: float) -> list[ExpectedGains]:
    """Predict gains from the derivative at psi, averaged over ``trials`` trainings with different random numbers.

    psi does not move.

    Raises:
        ValueError: there is no trial, or the fraction is outside (0, 1].
    """
    if trials < 1 or not 0.0 < moved <= 1.0:
        raise ValueError(f"want trials >= 1 and moved in (0, 1], got {trials}, {moved}")
    results = []
    for _ in range(trials):
        results.append(loop.derivative())
        loop.renew()
    return gains_of(
        results,
        loop.scene.distribution,
        loop.psi.detach(),
        loop.scene.names,
        moved,
        loop.settings.steps if isinstance(loop.settings.steps, TrustRegion) else TrustRegion(),
    )


def gains_of(
    results: list[Hypergradient],
    distribution: SceneDistribution,
    psi: Float[Tensor, "objects K"],
    names: tuple[str, ...],
    moved: float,
    region: TrustRegion,
) -> list[ExpectedGains]:
    """Average derivatives at one psi, and compute the gains of moves and of a step in ``region``."""
    parts, found = distribution.split(psi), []
    for factor in distribution.factors:
        own = parts[factor.name]
        p = factor.p_of(own)
        average = Average.zeros(own)
        for result in results:
            gradient, error = (distribution.split(v)[factor.name] for v in stacked(result, names, psi))
            average = average.joined(*slopes_by_p(factor, own, gradient, error))
        variance = average.variance
        bins = torch.eye(p.shape[-1], dtype=p.dtype)
        toward = moved * (bins - p[:, None, :])  # [objects, bin moved to, change of p]
        radius = torch.full_like(p[:, 0], region.radius)
        step = factor.p_of(step_within(factor, own, average.value, radius, region.keep)) - p
        gains, spread = _along(toward, average.value[:, None], variance[:, None])
        step_gain, step_spread = _along(step, average.value, variance)
        p_values = average.p_values
        for i, name in enumerate(names):
            by_bin, by_bin_error = (_opened(values[i], average.open[i]) for values in (gains, spread))
            found.append(
                ExpectedGains(
                    name, factor.name, float(p_values[i]), moved, by_bin, by_bin_error, float(step_gain[i]),
                    float(step_spread[i]),
                )
            )  # fmt: skip
    return found


def _along(change: Tensor, direction: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first-order gain of a change of p, and its standard error if components err independently."""
    return (change * direction).sum(-1), (change.square() * variance).sum(-1).sqrt()


def _opened(values: Float[Tensor, "k"], open_: Bool[Tensor, "k"]) -> tuple[float | None, ...]:
    """Return the values of open bins, and None for closed ones."""
    return tuple(float(value) if counts else None for value, counts in zip(values, open_, strict=True))


@dataclass(frozen=True)
class PhotographGain:
    """How far L_val falls if photographs are added to the training images.

    Attributes:
        photographs: number of photographs.
        fall: fall of L_val.
        error: its standard error over trainings; None for a single training.
    """

    photographs: int
    fall: float
    error: float | None


def photograph_gains(
    loop: GradientLoop, photographs: LabelledImages, counts: Sequence[int], trials: int, seed: int
) -> list[PhotographGain]:
    """Train as the loop does at its psi, without photographs and with each of ``counts``; psi does not move.

    Photographs are half of every batch, drawn repeatedly. The trainings of a trial share their random numbers, so that
    only the photographs make them differ. Counts above the number of photographs are reduced to it.

    Raises:
        ValueError: there is no trial, or a count is below 1.
    """
    if trials < 1 or min(counts, default=1) < 1:
        raise ValueError(f"want trials >= 1 and counts of at least 1, got {trials}, {list(counts)}")
    known = sorted({min(count, len(photographs)) for count in counts})
    losses: dict[int, list[float]] = {count: [] for count in (0, *known)}
    numbers = replace(loop.numbers, common=True)
    for _ in range(trials):
        for count, values in losses.items():
            inner = replace(loop.inner, photographs=None)
            if count:
                real = Real("combined", count=count)
                chosen = real.chosen(photographs, seed).to(inner.device)
                inner = replace(
                    inner,
                    training=replace(inner.training, real=real),
                    photographs=CachedSet.of(inner.detector, inner.backbone, chosen),
                )
            values.append(inner.train(loop.psi, numbers, loop.theta).validation_loss)
        numbers = numbers.renewed()
    return [_gain(count, losses[0], losses[count]) for count in known]


def _gain(count: int, without: Sequence[float], with_them: Sequence[float]) -> PhotographGain:
    falls = [a - b for a, b in zip(without, with_them, strict=True)]
    error = statistics.stdev(falls) / math.sqrt(len(falls)) if len(falls) > 1 else None
    return PhotographGain(count, statistics.fmean(falls), error)


def equivalent(gains: Sequence[PhotographGain], fall: float) -> float | None:
    """Interpolate the number of photographs at which L_val falls this far.

    It is 0 if it need not fall, and None if more photographs are needed than were tried.
    """
    if fall <= 0.0:
        return 0.0
    before = PhotographGain(0, 0.0, None)
    for gain in sorted(gains, key=lambda g: g.photographs):
        if gain.fall >= fall:
            part = (fall - before.fall) / (gain.fall - before.fall)
            return before.photographs + part * (gain.photographs - before.photographs)
        before = gain
    return None
