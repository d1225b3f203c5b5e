"""Means over seeds, or over trainings, with 95 % intervals.

A score differs between seeds (objects' fields, training and test images, initial parameters) and between test images.
A few seeds tell little of their own scatter, so that an interval has Student's quantile for it. Resampling the seeds
instead covers the truth in 81, 86 and 92 of 100 cases with 2, 3 and 5 of them. Where all seeds share the test images,
as trainings repeated on one target do, the images' part of a mean does not shrink with the number of seeds. It is
therefore added, as squares. Where each seed has test images of its own, the scatter between seeds has that part
already, and intervals are a little wide: they cover 98 of 100. ``python benchmarks/intervals.py`` measures both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import norm
from scipy.stats import t as student

NORMAL = float(norm.ppf(0.975))


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval, None where there is nothing to tell it from."""

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def certain(self) -> bool:
        """Whether there is an interval, and leaves 0 out."""
        return self.low is not None and self.high is not None and (self.low > 0.0 or self.high < 0.0)

    @property
    def as_fraction(self) -> Estimate:
        """Of a number in [0, 1], such as a score: the part of the interval that lies there."""
        if self.low is None or self.high is None:
            return self
        return Estimate(self.value, max(self.low, 0.0), min(self.high, 1.0))


def over_seeds(values: Float[np.ndarray, "seeds"]) -> Estimate:
    """The mean with Student's interval; that of one seed has none."""
    value, n = float(np.mean(values)), len(values)
    if n == 1:
        return Estimate(value)
    half = _quantile(n) * float(np.std(values, ddof=1))
    return Estimate(value, value - half, value + half)


def over_seeds_and_images(
    values: Float[np.ndarray, "seeds"], resampled: Float[np.ndarray, "draws seeds"]
) -> Estimate:
    """The mean over seeds; ``resampled`` has the values under resampled test images, nan where they show no box.

    One seed's interval is from the 2.5 % to the 97.5 % quantile over images.
    """
    if len(values) == 1:
        return over_images(float(values[0]), resampled[:, 0])
    value = float(np.mean(values))
    half = math.sqrt(max(_covariance(values, values, resampled, resampled), 0.0))
    return Estimate(value, value - half, value + half)


def over_images(value: float, resampled: Float[np.ndarray, "draws"]) -> Estimate:
    """A value with the 2.5 % and 97.5 % quantiles of its resampled ones, nan left out."""
    low, high = np.nanquantile(resampled, [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def ratio(
    numerator: Float[np.ndarray, "seeds"],
    denominator: Float[np.ndarray, "seeds"],
    numerators: Float[np.ndarray, "draws seeds"],
    denominators: Float[np.ndarray, "draws seeds"],
) -> Estimate:
    """The mean numerator by the mean denominator, both over seeds and resampled test images.

    The interval is Fieller's: all ratios r for which the mean of numerator - r denominator is not told from 0. It is
    unbounded, and None here, where the denominator is not told from 0.

    Source: Fieller, Some problems in interval estimation (J. R. Stat. Soc. B 16, 1954).
    """
    n, d = float(np.mean(numerator)), float(np.mean(denominator))
    value = n / d if d else math.nan
    nn = _covariance(numerator, numerator, numerators, numerators)
    nd = _covariance(numerator, denominator, numerators, denominators)
    dd = _covariance(denominator, denominator, denominators, denominators)
    square = d * d - dd
    if square <= 0.0:
        return Estimate(value)
    # (n - r d)^2 <= nn - 2 r nd + r^2 dd, with two roots wherever the square's factor is positive.
    root = math.sqrt(max((n * d - nd) ** 2 - square * (n * n - nn), 0.0))
    return Estimate(value, (n * d - nd - root) / square, (n * d - nd + root) / square)


def _quantile(seeds: int) -> float:
    """By which a standard deviation between seeds becomes half of their mean's interval; 0 of one seed."""
    return float(student.ppf(0.975, seeds - 1)) / math.sqrt(seeds) if seeds > 1 else 0.0


def _covariance(
    a: Float[np.ndarray, "seeds"],
    b: Float[np.ndarray, "seeds"],
    a_resampled: Float[np.ndarray, "draws seeds"],
    b_resampled: Float[np.ndarray, "draws seeds"],
) -> float:
    """Of two means over seeds, its parts times the squares of their quantiles; of a = b, half an interval's square."""
    of_seeds = float(np.cov(a, b)[0, 1]) if len(a) > 1 else 0.0
    pair = np.stack([a_resampled.mean(1), b_resampled.mean(1)])
    known = pair[:, ~np.isnan(pair).any(0)]
    of_images = float(np.cov(known)[0, 1]) if known.shape[1] > 1 else math.nan
    return _quantile(len(a)) ** 2 * of_seeds + NORMAL**2 * of_images
