"""The estimate of one factor of an object's psi, and the evidence for it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.parameter.distributions import total_variation

Finding = Literal[
    "moves", "nearer", "stays", "uncertain", "not told apart", "fits no render", "too few boxes"
]
MOVING: frozenset[Finding] = frozenset({"moves", "nearer"})
"""Findings with which psi moves to the estimate."""


@dataclass(frozen=True)
class Span:
    """Probabilities ``p`` with intervals, and expected total variations from the target's distribution.

    Attributes:
        p: the probabilities.
        low: lower ends of their intervals.
        high: upper ends of their intervals.
        doubt: expected total variation between ``p`` and the target.
        apart: the same between the present psi and the target.
    """

    p: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    doubt: float
    apart: float

    @staticmethod
    def of(
        p: Float[Tensor, "k"], drawn: Float[Tensor, "draws k"], now: Float[Tensor, "k"], covered: float
    ) -> Span:
        """Compute intervals that contain the central fraction ``covered`` of ``drawn``, and both total variations.

        ``drawn`` are random draws of the target's probabilities, which ``p`` estimates; ``now`` are those at the
        present psi.
        """
        tail = 0.5 * (1.0 - covered)
        low, high = (tuple(drawn.quantile(part, 0).tolist()) for part in (tail, 1.0 - tail))
        doubt, apart = (float(total_variation(drawn, q.to(drawn).expand_as(drawn)).mean()) for q in (p, now))
        return Span(tuple(p.tolist()), low, high, doubt, apart)


@dataclass(frozen=True)
class FactorEstimate:
    """Estimate of one factor of an object's psi from the target's boxes, with the evidence for it.

    Attributes:
        name: the object.
        factor: the factor of psi.
        boxes: number of boxes that were read; those of one view count as one (``views_of``).
        start: probabilities of the bins, or weights of the lights, at the present psi.
        p: estimated probabilities of the bins, or weights of the lights.
        low: lower ends of their intervals.
        high: upper ends of their intervals.
        groups: bins (from 1) that look the same; psi decides how a group's probability is divided among them.
        p_value: p-value of the null hypothesis that the target is at the present psi.
        strange: probability that a box looks less like the renders than a held-out render does; 0.5 if boxes look like
            renders.
        accuracy: fraction of held-out renders whose group of bins is recognised; for lights, the fraction of the
            guesses' variance that weights explain.
        finding: whether psi moves to the estimate. It does if the finding is ``moves``, or ``nearer``: the estimate is
            not final, but is expected to be much nearer to the target than the present psi is. It ``stays`` if the
            target may be at the present psi. Nor does it move if the estimate is ``uncertain``, renders are
            ``not told apart``, the target ``fits no render``, or there are ``too few boxes``.
        chance: accuracy of guessing without looking.
        doubt: expected total variation between the estimate and the target's distribution.
        apart: the same between the present psi and the target's distribution.
        converged: whether the search for the mixture converged, which it does not if the likelihood is flat.
        lights: whether ``p`` are weights of lights instead of probabilities of bins.
        repeated: number of further boxes, in near-duplicates of the images that count.
        guessed: whether a training tried a guess in place of the estimate, because the detector found next to none of
            the object (``outer.first_step.with_guesses``).
    """

    name: str
    factor: str
    boxes: int
    start: tuple[float, ...]
    p: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    groups: tuple[tuple[int, ...], ...]
    p_value: float
    strange: float
    accuracy: float
    finding: Finding
    chance: float = 0.0
    doubt: float = 0.0
    apart: float = 0.0
    converged: bool = True
    lights: bool = False
    repeated: int = 0
    guessed: bool = False

    @property
    def sentence(self) -> str:
        """Return the finding as a sentence for the console and the pages."""
        if self.finding == "too few boxes":
            repeated = f", and {self.repeated} in images that look like theirs" if self.repeated else ""
            ending = f", {self._otherwise}" if self.guessed else ""
            return (
                f"{self.name}: too few boxes ({self.boxes}{repeated}) to estimate its {self.factor}{ending}"
            )
        if self.finding == "fits no render":
            return (
                f"{self.name}: its boxes do not look like its renders (a box is stranger than a held-out render in "
                f"{self.strange:.0%} of pairs, 50% if they look alike), {self._otherwise}"
            )
        if self.finding == "not told apart":
            why = f"{self.accuracy:.0%} of held-out ones are recognised, {self.chance:.0%} by chance"
            if self.lights:
                explained = max(0.0, self.accuracy)
                why = f"weights explain {explained:.0%} of the variance of guesses on held-out ones"
            if not self.converged:
                why = f"the likelihood is flat; {why}"
            return f"{self.name}: its {self.factor} cannot be read from renders ({why}), {self._otherwise}"
        if self.finding == "uncertain":
            return (
                f"{self.name}: its boxes do not determine its {self.factor} (the estimate may be off by "
                f"{self.doubt:.2f} in total variation), {self._otherwise}"
            )
        shown = ", ".join(
            f"{self._called(group)} ({_sum(self.low, group):.2f} to {_sum(self.high, group):.2f})"
            for group in self._largest
        )
        ending = ""
        if self.finding == "stays":
            ending = f"; psi stays, because it may be right already (p = {self.p_value:.2g})"
        if self.finding == "nearer":
            ending = (
                f"; the estimate may be off by {self.doubt:.2f} in total variation, but psi is off by "
                f"{self.apart:.2f}"
            )
        where = "under" if self.lights else f"in {self.factor}"
        return f"your target shows the {self.name} {where} {shown}{ending}"

    @property
    def _otherwise(self) -> str:
        if self.guessed:
            return "and the detector found next to none of it, so a training tries a guess"
        return "so psi stays"

    def _called(self, group: Sequence[int]) -> str:
        what = ("light" if self.lights else "bin") + ("s" if len(group) > 1 else "")
        return f"{what} " + "/".join(str(b) for b in group)

    @property
    def _largest(self) -> list[tuple[int, ...]]:
        """The most probable groups, until they make up three quarters; at most three."""
        ordered = sorted(self.groups, key=lambda group: -_sum(self.p, group))
        shown, total = [], 0.0
        for group in ordered[:3]:
            shown.append(group)
            total += _sum(self.p, group)
            if total > 0.75:
                break
        return shown


def estimates_of(stored: Iterable[Mapping[str, Any]]) -> tuple[FactorEstimate, ...]:
    """Invert ``dataclasses.asdict`` for several estimates."""
    tuples = {
        "start": tuple,
        "p": tuple,
        "low": tuple,
        "high": tuple,
        "groups": lambda g: tuple(map(tuple, g)),
    }
    return tuple(
        FactorEstimate(**{key: tuples.get(key, lambda v: v)(value) for key, value in one.items()})
        for one in stored
    )


def _sum(values: Sequence[float], group: Sequence[int]) -> float:
    return sum(values[b - 1] for b in group)


@dataclass(frozen=True)
class Strangeness:
    """Distance of features from those of renders: the Mahalanobis distance to the nearest cell (Lee et al. 2018).

    The linear effect of the light on the features is removed first.

    Attributes:
        means: mean features of every cell's renders.
        precision: inverse of the covariance that all cells share.
        light: linear coefficients of the features on the weights of the lights.
    """

    means: Float[Tensor, "cells d"]
    precision: Float[Tensor, "d d"]
    light: Float[Tensor, "lights d"]

    @staticmethod
    def of(
        features: Float[Tensor, "n d"],
        cells: Int[Tensor, "n"],
        weights: Float[Tensor, "n lights"],
        shrinkage: float = 0.1,
    ) -> Strangeness:
        """Fit means and covariance; ``shrinkage`` pulls the covariance towards a multiple of the identity."""
        eye = torch.eye(weights.shape[1], dtype=features.dtype)
        light = torch.linalg.solve(weights.T @ weights + 1e-6 * eye, weights.T @ features)
        features = features - weights @ light
        own, index = cells.unique(return_inverse=True)
        counts = torch.bincount(index, minlength=len(own)).to(features)
        means = (
            features.new_zeros(len(own), features.shape[1]).index_add_(0, index, features) / counts[:, None]
        )
        left = features - means[index]
        covariance = left.T @ left / max(len(features) - len(own), 1)
        size = covariance.diagonal().mean().clamp_min(1e-12)
        eye = torch.eye(len(covariance), dtype=features.dtype)
        precision = torch.linalg.inv((1.0 - shrinkage) * covariance + shrinkage * size * eye)
        return Strangeness(means, precision, light)

    def __call__(
        self, features: Float[Tensor, "n d"], weights: Float[Tensor, "*n lights"]
    ) -> Float[Tensor, "n"]:
        """Compute the squared distance of each sample, seen under lights with these weights."""
        apart = (features - weights @ self.light)[:, None, :] - self.means
        return (apart @ self.precision * apart).sum(-1).amin(-1)


def part_farther(seen: Float[Tensor, "m"], known: Float[Tensor, "n"], frequency: Float[Tensor, "n"]) -> float:
    """Return the probability that one of ``seen`` is larger than one of ``known``, ties counting half.

    Args:
        seen: distances of boxes.
        known: distances of held-out renders.
        frequency: weight of each render, in proportion to how often the boxes show its cell; not normalised.

    Returns:
        The probability; 0.5 without boxes or renders.
    """
    total = frequency.sum()
    if not len(seen) or not float(total) > 0.0:
        return 0.5
    larger = (seen[:, None] > known).double() + 0.5 * (seen[:, None] == known).double()
    return float((larger @ (frequency / total)).mean())
