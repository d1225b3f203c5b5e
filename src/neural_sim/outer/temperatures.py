"""The Gumbel-softmax temperature's effect on draws, and on the pathwise derivative's bias and variance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.frozen import FrozenLoop, centred
from neural_sim.parameter.bins import gumbel
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.noise import BinNoise


@dataclass(frozen=True)
class AtTemperature:
    """One object at one tau, all from the same noise.

    ``frequencies`` are the fractions of the relaxed draws in each bin. ``bias`` is |mean estimate - truth| in centred
    logits, after subtracting the variance of both (0 where that is larger), ``bias_error`` its standard error.
    ``spread`` is the square root of the variance, summed over components, of an estimate from ``images`` images.
    ``cosine`` is that of the mean estimate with the truth.
    """

    object: str
    temperature: float
    frequencies: list[float]
    bias: float
    bias_error: float
    spread: float
    cosine: float
    images: int


@dataclass(frozen=True)
class Truth:
    """One object's derivative over hard bins.

    ``length`` is its norm, ``noise`` its standard error, ``spread`` the stratified estimator's with as many images as a
    row of :class:`AtTemperature`. ``probabilities`` are p, the expected frequencies of draws.
    """

    object: str
    length: float
    noise: float
    spread: float
    probabilities: list[float]


@dataclass(frozen=True)
class Temperatures:
    """``+experiment=gumbel_temperature``.

    Args:
        values: the temperatures tau.
        rounds: estimates at each tau, from ``outer.images_per_object`` images each.
        truth_per_bin: images of every bin for the truth.
        draws: of the relaxed bin, for the frequencies.

    Raises:
        ValueError: no temperature, one that is not positive, or fewer than two rounds, images or draws.
    """

    values: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
    rounds: int = 8
    truth_per_bin: int = 240
    draws: int = 20_000

    def __post_init__(self) -> None:
        if not self.values or not all(value > 0.0 for value in self.values):
            raise ValueError(f"temperatures.values: want positive numbers, got {list(self.values)}")
        if min(self.rounds, self.truth_per_bin, self.draws) < 2:
            raise ValueError(
                "temperatures: rounds, truth_per_bin and draws must be at least 2, got "
                f"{self.rounds}, {self.truth_per_bin} and {self.draws}"
            )

    def measure(
        self, loop: FrozenLoop, estimator: PathwiseEstimator, images: int, seed: int
    ) -> tuple[list[AtTemperature], list[Truth]]:
        """Every object at every temperature, estimates from ``images`` images each; and the truth."""
        names, bins = loop.scene.names, loop.bins.bins
        hard = loop.truth(self.truth_per_bin, torch.Generator().manual_seed(seed))
        truth, errors = centred(hard), torch.stack([part.standard_error for part in hard])
        truths = [
            Truth(
                name,
                float(truth[label].norm()),
                float(errors[label].norm()),
                float(errors[label].norm()) * math.sqrt(self.truth_per_bin * bins / images),
                loop.bins.log_probabilities(loop.psi[label]).exp().tolist(),
            )
            for label, name in enumerate(names)
        ]
        rows = []
        for value in self.values:
            moved = loop.with_factor(replace(loop.bins, temperature=value))
            generator = torch.Generator().manual_seed(seed + 1)  # the same noise at every temperature
            estimates = torch.stack(
                [centred(moved.pathwise(estimator, images, generator)) for _ in range(self.rounds)]
            )
            for label, name in enumerate(names):
                frequencies = bin_frequencies(moved.bins, moved.psi[label], self.draws, seed + 2)
                rows.append(
                    AtTemperature(
                        name,
                        value,
                        frequencies,
                        *against(estimates[:, label], truth[label], errors[label]),
                        images,
                    )
                )
        return rows, truths


def against(
    estimates: Float[Tensor, "rounds k"], truth: Float[Tensor, "k"], truth_errors: Float[Tensor, "k"]
) -> tuple[float, float, float, float]:
    """Bias, its standard error, spread and cosine of independent estimates, see :class:`AtTemperature`."""
    mean, variance = estimates.mean(0), estimates.var(0)
    off = mean - truth
    noise = variance / len(estimates) + truth_errors.square()
    bias = math.sqrt(max(0.0, float(off.square().sum() - noise.sum())))
    # |off| varies with the noise along off; without a bias, with all of it.
    along = float((off.square() * noise).sum().sqrt() / off.norm().clamp_min(1e-30))
    error = along if bias > 0.0 else float(noise.sum().sqrt())
    cosine = float(mean @ truth / (mean.norm() * truth.norm()).clamp_min(1e-30))
    return bias, error, float(variance.sum().sqrt()), cosine


def bin_frequencies(factor: BinnedFactor, psi: Float[Tensor, "k"], draws: int, seed: int) -> list[float]:
    """Fractions of the relaxed draws in each bin, each draw at its bins' middles (without the offset within a bin)."""
    generator = torch.Generator().manual_seed(seed)
    noise = BinNoise(gumbel((draws, factor.bins), generator, torch.float64))
    middle = torch.full((draws,), 0.5, dtype=torch.float64)
    where = factor.bin_of(factor.relaxed(psi.double(), noise, middle)[0])
    return (torch.bincount(where, minlength=factor.bins) / draws).tolist()
