"""The response of training: the change of an object's score when a fraction of its images moves to one bin.

It takes no derivative. The training is repeated, with common random numbers, once for each bin of a factor. Each run
moves all objects at once, each to another bin, and reads each object's response from its score. The response is the
reference for hypergradients of the loop's training, and a method by itself (``baseline=response``), at the cost of one
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
from neural_sim.parameter.factor import Factor
from neural_sim.solver.base import Solution, Status
from neural_sim.solver.damping import Damped
from neural_sim.synthesis.assembly import RenderedImages

PART = 0.15
"""Fraction of an object's images that move."""
SPACING = 3
"""Bins between those that consecutive objects move to in one run, so that pairs of objects differ from run to run."""


@dataclass(frozen=True)
class Response:
    """``value``: the gain of each object's score when a fraction of its images moves to each bin (or of its weights to
    each light), divided by that fraction. ``trainings`` counts the trainings that were run.
    """

    value: Float[Tensor, "objects K"]
    trainings: int

    def slopes(self, inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> Float[Tensor, "objects K"]:
        """The derivative by psi that the response implies, of L_val = minus the mean score over classes."""
        distribution, parts = inner.scene.distribution, {}
        values, at = distribution.split(self.value), distribution.split(psi)
        for factor in distribution.factors:
            scale = factor.log_slopes(at[factor.name]).exp()
            value = values[factor.name]
            mean = (scale * value).sum(1, keepdim=True) / scale.sum(1, keepdim=True)
            parts[factor.name] = -scale * (value - mean) / len(psi)
        return distribution.join(parts)


def response(inner: InnerLoop, psi: Float[Tensor, "objects K"], part: float = PART) -> Response:
    """The response at ``psi``: one training at psi and one for each bin of each factor; theta does not change.

    Raises:
        ValueError: a part that is not in (0, 1].
    """
    if not 0.0 < part <= 1.0:
        raise ValueError(f"response: part must lie in (0, 1], got {part}")
    before = inner.theta, inner.trajectory, inner.common_numbers
    inner.common_numbers = True
    distribution, values = inner.scene.distribution, {}
    base = _scores(inner, psi)
    objects, trainings = torch.arange(len(psi)), 1
    for factor in distribution.factors:
        value = psi.new_zeros(len(psi), factor.size)
        for run in range(factor.size):
            bins = (run + SPACING * objects) % factor.size
            gain = _scores(inner, _moved(inner, psi, factor, bins, part)) - base
            value[objects, bins] = gain[: len(psi)].to(value) / part
        values[factor.name], trainings = value, trainings + factor.size
    inner.theta, inner.trajectory, inner.common_numbers = before
    return Response(distribution.join(values), trainings)


def agreement(
    inner: InnerLoop, psi: Float[Tensor, "objects K"], result: Hypergradient, learned: Sequence[int]
) -> float:
    """Cosine of the derivatives ``result`` with the response at ``psi``, in centred derivatives by p, averaged over
    objects and factors; nan where one of them vanishes.
    """
    distribution = inner.scene.distribution
    truth = distribution.split(response(inner, psi).slopes(inner, psi))
    cosines = []
    for label in learned:
        gradient = distribution.split(result.psi_gradients[inner.scene.names[label]])
        for factor in distribution.factors:
            scale = factor.log_slopes(distribution.split(psi[label])[factor.name]).exp()
            cosines.append(centred_cosine(gradient[factor.name] / scale, truth[factor.name][label] / scale))
    known = [cosine for cosine in cosines if not math.isnan(cosine)]
    return sum(known) / len(known) if known else math.nan


def centred_cosine(left: Float[Tensor, "k"], right: Float[Tensor, "k"]) -> float:
    """Cosine of two gradients after subtracting their means (a constant added to logits does not change softmax).

    Not a number where either vanishes.
    """
    left, right = (g.double() - g.double().mean() for g in (left, right))
    size = float(left.norm() * right.norm())
    return float(left @ right) / size if size > 0.0 else math.nan


class ResponseLoop(GradientLoop):
    """psi follows the response in the place of a derivative."""

    def __init__(self, inner: InnerLoop, psi: Float[Tensor, "objects K"], part: float) -> None:
        super().__init__(inner, psi)
        self.part = part

    def _derivative(self, rendered: RenderedImages, cached: CachedSet) -> Hypergradient:
        slopes = response(self.inner, self.psi, self.part).slopes(self.inner, self.psi)
        zero = torch.zeros_like(slopes[0])
        gradients = {
            name: slopes[i] if i in self._learned else zero for i, name in enumerate(self.scene.names)
        }
        solution = Solution(torch.zeros(1), Status.MEASURED, 0, 0.0, (0.0, 0.0), 0, False)
        # Its noise is not known; the training at the new psi decides on each step.
        errors = dict.fromkeys(gradients, zero)
        return Hypergradient(gradients, errors, {}, solution, Damped(0.0, None), math.nan, math.nan, math.nan)


def _moved(
    inner: InnerLoop, psi: Float[Tensor, "objects K"], factor: Factor, bins: Tensor, part: float
) -> Float[Tensor, "objects K"]:
    parts = inner.scene.distribution.split(psi)
    p = factor.p_of(parts[factor.name])
    moved = (1.0 - part) * p + part * torch.nn.functional.one_hot(bins, factor.size).to(p)
    return inner.scene.distribution.join({**parts, factor.name: factor.psi_of(moved)})


def _scores(inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> Float[Tensor, "classes"]:
    """Scores of a detector trained on images of ``psi``."""
    inner.train(inner.training_set(inner.draw(psi).images))
    return inner.scores().sum(1)
