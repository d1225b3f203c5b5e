"""The response of training itself: what the score of an object does when a part of its images moves to one bin.

No derivative is taken. The same training is run again, with common random numbers, for each bin of a factor; every run
moves all objects at once, each to another bin, and each object's own score is its own response. It is the truth that a
hypergradient of the loop's training should agree with, and a method of its own (``baseline=response``), which pays one
training for each bin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.retrained import centred_cosine
from neural_sim.parameter.factor import Factor
from neural_sim.solver.damping import Damped
from neural_sim.solver.solution import Solution, Status
from neural_sim.synthesis.assembly import RenderedImages

PART = 0.15
"""Of an object's images that move."""
SPACING = 3
"""Between the bins that consecutive objects move to in one run, so that neighbours are not always the same."""


@dataclass(frozen=True)
class Response:
    """Of every object: the rise of its own score by the part of its images that moved to each bin (or the part of its
    weights to each light), over that part. ``trainings`` were run for it."""

    value: Float[Tensor, "objects K"]
    trainings: int

    def slopes(self, inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> Float[Tensor, "objects K"]:
        """The derivative of L_val by psi that the response stands for, L_val minus the mean score of all classes."""
        distribution, parts = inner.scene.distribution, {}
        values, at = distribution.split(self.value), distribution.split(psi)
        for factor in distribution.factors:
            p = factor.log_probabilities(at[factor.name]).exp()
            value = values[factor.name]
            mean = (p * value).sum(1, keepdim=True) / p.sum(1, keepdim=True)
            parts[factor.name] = -p * (value - mean) / len(psi)
        return distribution.join(parts)


def response(inner: InnerLoop, psi: Float[Tensor, "objects K"], part: float = PART) -> Response:
    """The response at ``psi``, by one training for psi itself and one for each bin of each factor; theta stays.

    Raises:
        ValueError: a part that is not in (0, 1].
    """
    if not 0.0 < part <= 1.0:
        raise ValueError(f"response: part must lie in (0, 1], got {part}")
    before = inner.theta, inner.trajectory, inner.common_numbers
    inner.common_numbers = True
    distribution, found = inner.scene.distribution, {}
    base = _scores(inner, psi)
    objects, trainings = torch.arange(len(psi)), 1
    for factor in distribution.factors:
        value = psi.new_zeros(len(psi), factor.size)
        for run in range(factor.size):
            bins = (run + SPACING * objects) % factor.size
            rise = _scores(inner, _moved(inner, psi, factor, bins, part)) - base
            value[objects, bins] = rise[: len(psi)].to(value) / part
        found[factor.name], trainings = value, trainings + factor.size
    inner.theta, inner.trajectory, inner.common_numbers = before
    return Response(distribution.join(found), trainings)


def agreement(
    inner: InnerLoop, psi: Float[Tensor, "objects K"], result: Hypergradient, learned: Sequence[int]
) -> float:
    """The mean over objects and factors of the cosine of a derivative with the response at ``psi``, in centred slopes
    by p; nan where none of either is to be seen."""
    distribution = inner.scene.distribution
    truth = distribution.split(response(inner, psi).slopes(inner, psi))
    found = []
    for label in learned:
        told = distribution.split(result.psi_gradients[inner.scene.names[label]])
        for factor in distribution.factors:
            p = factor.log_probabilities(distribution.split(psi[label])[factor.name]).exp()
            found.append(centred_cosine(told[factor.name] / p, truth[factor.name][label] / p))
    known = [cosine for cosine in found if not math.isnan(cosine)]
    return sum(known) / len(known) if known else math.nan


class ResponseLoop(GradientLoop):
    """psi moved by the response: no derivative is taken, steps follow what trainings did."""

    def __init__(self, inner: InnerLoop, psi: Float[Tensor, "objects K"], part: float) -> None:
        super().__init__(inner, psi)
        self.part = part

    def _derivative(self, rendered: RenderedImages, cached: CachedSet) -> Hypergradient:
        slopes = response(self.inner, self.psi, self.part).slopes(self.inner, self.psi)
        nothing = torch.zeros_like(slopes[0])
        own = {name: slopes[i] if i in self._learned else nothing for i, name in enumerate(self.scene.names)}
        solution = Solution(torch.zeros(1), Status.MEASURED, 0, 0.0, (0.0, 0.0), 0, False)
        # Its noise is not known: what a step did decides.
        unknown = dict.fromkeys(own, nothing)
        return Hypergradient(own, unknown, {}, solution, Damped(0.0, None), math.nan, math.nan, math.nan)


def _moved(
    inner: InnerLoop, psi: Float[Tensor, "objects K"], factor: Factor, bins: Tensor, part: float
) -> Float[Tensor, "objects K"]:
    parts = inner.scene.distribution.split(psi)
    p = factor.p_of(parts[factor.name])
    there = torch.nn.functional.one_hot(bins, factor.size).to(p)
    return inner.scene.distribution.join(
        {**parts, factor.name: factor.psi_of((1.0 - part) * p + part * there)}
    )


def _scores(inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> Float[Tensor, "classes"]:
    """Of a detector trained on images of ``psi``."""
    inner.train(CachedSet.of(inner.detector, inner.backbone, inner.draw(psi).images))
    return inner.scores().sum(1)
