"""The sequence of psi that each object has had, its way, and the choice of the one that a loop returns.

Scores scatter between trainings, and only one pair of trainings judges a step: a slightly harmful step may be accepted,
and harm that shows only in later trainings goes unnoticed. At the end, every psi on the way is therefore judged by all
the trainings that used it. The largest of several noisy means is too often a lucky one, so the values m_v of an
object's psi are fitted to the scores y_t of its trainings, assuming that successive psi have similar values:

    minimise over m    sum_t (y_t - m_v(t))^2 + w sum_v f(m_v - m_(v-1)),    f(x) = c^2 log(1 + x^2 / c^2)

This m is the most probable one if scores have normal errors, with standard deviation s between trainings, and steps
change the values by about s / sqrt(w), a few by much more (Student's t). c is three times s.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

WEIGHT = 4.0
"""w, for steps that mostly change a score by half of its scatter. In simulations (tests/outer/test_way.py), 1 takes
back too many good steps, and 8 too few bad ones."""
LARGE = 3.0
"""c in units of s: larger changes of score between neighbours are hardly smoothed."""
REPETITIONS = 50


@dataclass(frozen=True)
class Stay:
    """One psi on an object's way.

    Attributes:
        psi: the object's psi.
        scores: the object's score in every training at this psi; higher is better.
    """

    psi: Float[Tensor, "K"]
    scores: tuple[float, ...] = ()


@dataclass(frozen=True)
class TakenBack:
    """An object that goes back to an earlier psi at the end.

    Attributes:
        kept: number of its accepted steps that it keeps; 0: it goes back to the initial psi.
        accepted: number of its accepted steps.
        gain: estimated gain in score of the returned psi over the last one.
    """

    kept: int
    accepted: int
    gain: float


@dataclass(frozen=True)
class Way:
    """Every psi that each learned object has had, with its scores; ``stays`` by name."""

    stays: Mapping[str, tuple[Stay, ...]]

    @staticmethod
    def begin(names: Sequence[str], psi: Float[Tensor, "objects K"]) -> Way:
        """Start at ``psi``, before the first training."""
        return Way({name: (Stay(row.clone()),) for name, row in zip(names, psi, strict=True)})

    def moved(self, name: str, psi: Float[Tensor, "K"]) -> Way:
        """Add the psi to which an object has moved."""
        return self._with(name, (*self.stays[name], Stay(psi.clone())))

    def settled(self, names: Collection[str]) -> Way:
        """Forget where the named objects were before, so that they cannot go back there."""
        return Way({name: stays[-1:] if name in names else stays for name, stays in self.stays.items()})

    def seen(self, name: str, score: float) -> Way:
        """Add an object's score in a training at its present psi."""
        *before, here = self.stays[name]
        return self._with(name, (*before, replace(here, scores=(*here.scores, score))))

    def _with(self, name: str, stays: tuple[Stay, ...]) -> Way:
        return Way({**self.stays, name: stays})

    @property
    def variance(self) -> float | None:
        """Variance of a score between trainings at one psi, pooled over objects; None if no psi was trained twice."""
        squares, freedom = 0.0, 0
        for scores in (stay.scores for stays in self.stays.values() for stay in stays):
            if len(scores) > 1 and all(map(math.isfinite, scores)):
                squares, freedom = (
                    squares + (len(scores) - 1) * statistics.variance(scores),
                    freedom + len(scores) - 1,
                )
        return squares / freedom if freedom else None

    def best(self) -> dict[str, tuple[Stay, TakenBack]]:
        """Return, for each object whose best psi is not its last one, that psi and what is taken back.

        The result is empty if no psi was trained on twice, because the scatter of trainings is then unknown.
        """
        found, variance = {}, self.variance
        for name, stays in self.stays.items():
            if variance is None or not all(math.isfinite(score) for stay in stays for score in stay.scores):
                continue
            values = fitted_scores([stay.scores for stay in stays], variance)
            place = int(values.argmax())
            gain = float(values[place] - values[-1])
            if gain > 0.0:
                found[name] = stays[place], TakenBack(place, len(stays) - 1, gain)
        return found


def fitted_scores(
    scores: Sequence[Sequence[float]], variance: float, weight: float = WEIGHT
) -> Float[Tensor, "stays"]:
    """Estimate the score of each psi on an object's way, by iteratively reweighted least squares.

    Args:
        scores: scores of the trainings at each psi; at least one for every psi.
        variance: s^2, the variance of a score between trainings.
        weight: w, the number of trainings that a neighbour on the way is worth.

    Raises:
        ValueError: some psi has no score.
    """
    if not scores or not all(scores):
        raise ValueError(f"fitted_scores: want a score of every psi, got {scores}")
    counts = torch.tensor([len(each) for each in scores], dtype=torch.float64)
    sums = torch.tensor([sum(each) for each in scores], dtype=torch.float64)
    steps = torch.diff(torch.eye(len(scores), dtype=torch.float64), dim=0)
    large = max(LARGE**2 * variance, torch.finfo(torch.float64).tiny)
    values = sums / counts
    for _ in range(REPETITIONS):
        held = weight / (1.0 + (steps @ values).square() / large)
        values = torch.linalg.solve(torch.diag(counts) + steps.T @ (held[:, None] * steps), sums)
    return values
