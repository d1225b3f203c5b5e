"""The finite-difference response of training: how an object's score changes when its images move to one bin.

No derivative is computed. The training is repeated, with common random numbers, once for each bin of a factor. Each run
moves all objects at once, consecutive ones to different bins, and measures each object's response by its score. The
response is the reference for hypergradients of the loop's training, and a method of its own (``baseline=response``). It
costs one training at psi, and one for each bin of each factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.detector.protocol import Parameters
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.inner import InnerLoop, Numbers, Trained
from neural_sim.outer.objective import Objective
from neural_sim.outer.records import Cost
from neural_sim.outer.steps import LearnedObjects
from neural_sim.parameter.bins import is_closed
from neural_sim.parameter.factor import Factor

PART = 0.15
"""Fraction of an object's images that move to the bin."""
SPACING = 3
"""Distance between the bins of consecutive objects in one run, so that they move to different bins; 1 for a factor of
three bins."""


@dataclass(frozen=True)
class Response:
    """The finite-difference response of training.

    Attributes:
        value: rise of each object's score when a fraction of its images moves to each bin (or of its weights to
            each light), divided by that fraction.
        trainings: number of trainings that were run.
        cost: their total cost.
    """

    value: Float[Tensor, "objects K"]
    trainings: int
    cost: Cost = field(default_factory=Cost)

    def slopes(self, inner: InnerLoop, psi: Float[Tensor, "objects K"]) -> Float[Tensor, "objects K"]:
        """Compute the derivative with respect to psi that the response implies; L_val is minus the mean class score."""
        distribution, parts = inner.scene.distribution, {}
        values, at = distribution.split(self.value), distribution.split(psi)
        for factor in distribution.factors:
            scale = factor.log_slopes(at[factor.name]).exp()
            value = values[factor.name]
            mean = (scale * value).sum(1, keepdim=True) / scale.sum(1, keepdim=True)
            parts[factor.name] = -scale * (value - mean) / len(psi)
        return distribution.join(parts)


def response(
    inner: InnerLoop,
    psi: Float[Tensor, "objects K"],
    numbers: Numbers,
    theta: Parameters | None = None,
    part: float = PART,
) -> Response:
    """Measure the response at ``psi``, by one training at psi and one for each bin of each factor.

    Args:
        inner: the inner problem.
        psi: where the response is measured.
        numbers: random numbers that the trainings share.
        theta: initial parameters of each training if ``outer.start=previous``.
        part: fraction of an object's images that move.

    Raises:
        ValueError: ``part`` is not in (0, 1].
    """
    if not 0.0 < part <= 1.0:
        raise ValueError(f"response: part must lie in (0, 1], got {part}")
    distribution, values = inner.scene.distribution, {}
    common = replace(numbers, common=True)
    base = inner.train(psi, common, theta)
    before, cost = base.scores.sum(1), base.cost
    objects, trainings = torch.arange(len(psi)), 1
    for factor in distribution.factors:
        value = psi.new_zeros(len(psi), factor.size)
        for run in range(factor.size):
            bins = (run + (SPACING % factor.size or 1) * objects) % factor.size
            trained = inner.train(_moved(inner, psi, factor, bins, part), common, theta)
            gain = trained.scores.sum(1) - before
            value[objects, bins] = gain[: len(psi)].to(value) / part
            cost = cost + trained.cost
        values[factor.name], trainings = value, trainings + factor.size
    return Response(distribution.join(values), trainings, cost)


def agreement(
    slopes: Float[Tensor, "objects K"],
    psi: Float[Tensor, "objects K"],
    result: Hypergradient,
    objects: LearnedObjects,
) -> float | None:
    """Compare derivatives at ``psi`` with the ``slopes`` of the response.

    Returns:
        The cosine of the centred derivatives with respect to p, averaged over learned objects and factors; None if it
        is undefined for all of them, because a derivative vanishes.
    """
    distribution = objects.distribution
    truth = distribution.split(slopes)
    cosines = []
    for name, label in zip(objects.names, objects.labels, strict=True):
        gradient = distribution.split(result.gradients[name])
        for factor in distribution.factors:
            scale = factor.log_slopes(distribution.split(psi[label])[factor.name]).exp()
            drawn = scale > 0.0  # closed bins have no derivative with respect to p
            pair = (
                values[drawn] / scale[drawn] for values in (gradient[factor.name], truth[factor.name][label])
            )
            cosines.append(centred_cosine(*pair))
    known = [cosine for cosine in cosines if not math.isnan(cosine)]
    return sum(known) / len(known) if known else None


def centred_cosine(left: Float[Tensor, "k"], right: Float[Tensor, "k"]) -> float:
    """Compute the cosine of two gradients after centring (adding a constant to logits does not change softmax).

    The result is nan if either gradient vanishes.
    """
    left, right = (g.double() - g.double().mean() for g in (left, right))
    size = float(left.norm() * right.norm())
    return float(left @ right) / size if size > 0.0 else math.nan


class ResponseLoop(GradientLoop):
    """The loop in which psi follows the response instead of a derivative."""

    def __init__(
        self, inner: InnerLoop, psi: Float[Tensor, "objects K"], part: float, generator: torch.Generator
    ) -> None:
        super().__init__(inner, psi, generator)
        self.part = part

    @override
    def _derivative(self, trained: Trained, objective: Objective) -> Hypergradient[None]:
        found = response(self.inner, self.psi, self.numbers, self.theta, self.part)
        self.charge(found.cost)
        slopes = found.slopes(self.inner, self.psi)
        zero = torch.zeros_like(slopes[0])
        gradients = {
            name: slopes[i] if i in self.free.labels else zero for i, name in enumerate(self.scene.names)
        }
        # The errors are unknown. As 0, they leave the scatter between trainings as the only noise of the derivatives.
        return Hypergradient(gradients, dict.fromkeys(gradients, zero), None)


def _moved(
    inner: InnerLoop, psi: Float[Tensor, "objects K"], factor: Factor, bins: Tensor, part: float
) -> Float[Tensor, "objects K"]:
    parts = inner.scene.distribution.split(psi)
    p = factor.p_of(parts[factor.name])
    moved = (1.0 - part) * p + part * torch.nn.functional.one_hot(bins, factor.size).to(p)
    return inner.scene.distribution.join(
        {**parts, factor.name: factor.psi_of(moved, is_closed(parts[factor.name]))}
    )
