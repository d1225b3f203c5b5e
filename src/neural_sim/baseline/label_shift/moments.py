"""Weights of lights from a sample's mean by matching moments, because lights do not mix images (pure functions).

All images of an object share one light. Guesses y of the weights w are shrunk towards the most common renders, and so
are not estimates themselves; but over held-out renders of known weights their mean is nearly linear, E[y | w] = B w.
The weights are those at which it equals the target's mean (indirect inference, Gourieroux, Monfort and Renault 1993):

    w = argmin (ybar - B w)^T S^-1 (ybar - B w),    S = cov(ybar).

There are two guesses of each weight: the network's, and one that is linear in the colours of a crop's quarters, as
light itself is additive. S says which to trust: the colours, if few renders trained the network. Covariances between
the two are left out: otherwise the systematic errors of one would correct the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Project = Callable[[Float[Tensor, "*n k"]], Float[Tensor, "*n k"]]


@dataclass(frozen=True)
class Response:
    """How guesses depend on weights.

    slope: B.
    scatter: covariance of a guess around B w.
    precision: inverse of the sum of w w^T over the different renders from which B was fitted.
    explained: fraction of the guesses' variance that B w explains.
    """

    slope: Float[Tensor, "m k"]
    scatter: Float[Tensor, "m m"]
    precision: Float[Tensor, "k k"]
    explained: float

    @staticmethod
    def of(guesses: Float[Tensor, "n m"], weights: Float[Tensor, "n k"]) -> Response:
        """Fit B by least squares on renders of known weights."""
        eye = torch.eye(weights.shape[1], dtype=weights.dtype)
        precision = torch.linalg.inv(weights.T @ weights + 1e-6 * eye)
        slope = (precision @ weights.T @ guesses).T
        left = guesses - weights @ slope.T
        lights = weights.shape[1]
        own = torch.arange(guesses.shape[1]) // lights
        scatter = left.T @ left / max(len(left) - lights, 1) * (own[:, None] == own)
        least = (0.03 * scatter.diagonal()).clamp_min(1e-12).diag()  # weights sum to 1, and guesses nearly do
        several = len(weights) / len(weights.unique(dim=0))  # images of one render, whose errors are alike
        variance = float((guesses - guesses.mean(0)).square().sum())
        explained = 1.0 - float(left.square().sum()) / max(variance, 1e-12)
        return Response(slope, scatter + least, several * precision, explained)

    def covariance(self, boxes: int, weights: Float[Tensor, "k"]) -> Float[Tensor, "m m"]:
        """Compute the covariance of the mean of ``boxes`` guesses minus B w, including the error of B.

        The boxes share one light. The linear model's error for that light is the same in all of them and does not
        average out. Renders cannot separate it from differences between boxes, so all of the scatter is assumed to be
        of that kind.
        """
        return self.scatter * (1.0 + 1.0 / boxes + weights @ self.precision @ weights)

    def misfits(self, guesses: Float[Tensor, "n m"], project: Project) -> Float[Tensor, "n"]:
        """Compute the distance of each guess from those of any weights, as in Hansen's test of overidentification."""
        nearest = matched(guesses, self.slope, self.scatter, project)
        return distance(guesses, nearest, self.slope, self.scatter)


def fitted(
    inputs: Float[Tensor, "n d"],
    weights: Float[Tensor, "n k"],
    others: Float[Tensor, "m d"],
    ridge: float = 1e-3,
) -> Float[Tensor, "m k"]:
    """Guess weights linearly from inputs, fitted to renders of known weights (ridge regression)."""
    centre, middle = inputs.mean(0), weights.mean(0)
    apart = inputs - centre
    eye = ridge * len(inputs) * apart.square().mean().clamp_min(1e-12) * torch.eye(inputs.shape[1]).to(inputs)
    slope = torch.linalg.solve(apart.T @ apart + eye, apart.T @ (weights - middle))
    return middle + (others - centre) @ slope


def matched(
    mean: Float[Tensor, "*n m"],
    slope: Float[Tensor, "m k"],
    covariance: Float[Tensor, "m m"],
    project: Project,
    steps: int = 2000,
) -> Float[Tensor, "*n k"]:
    """Find the weights whose mean guess is nearest, by accelerated projected gradients (Beck and Teboulle 2009)."""
    inverse = torch.linalg.inv(covariance)
    inverse = inverse / inverse.diagonal().mean()
    quadratic = slope.T @ inverse @ slope
    linear = mean @ inverse @ slope
    rate = 1.0 / torch.linalg.eigvalsh(quadratic)[-1]
    lights = slope.shape[1]
    w = project(mean.new_full((*mean.shape[:-1], lights), 1.0 / lights))
    ahead, t = w, 1.0
    for _ in range(steps):
        new = project(ahead - rate * (ahead @ quadratic - linear))
        later = 0.5 * (1.0 + (1.0 + 4.0 * t * t) ** 0.5)
        ahead, change = new + (t - 1.0) / later * (new - w), float((new - w).abs().max())
        w, t = new, later
        if change < 1e-9:
            break
    return w


def distance(
    mean: Float[Tensor, "*#n m"],
    weights: Float[Tensor, "*#n k"],
    slope: Float[Tensor, "m k"],
    covariance: Float[Tensor, "m m"],
) -> Float[Tensor, "..."]:
    """Compute (ybar - B w)^T S^-1 (ybar - B w)."""
    left = mean - weights @ slope.T
    return (left @ torch.linalg.inv(covariance) * left).sum(-1)


def scattered(
    mean: Float[Tensor, "m"], covariance: Float[Tensor, "m m"], draws: int, generator: torch.Generator
) -> Float[Tensor, "draws m"]:
    """Draw means from the normal distribution around ``mean``."""
    noise = torch.randn(draws, len(mean), generator=generator, dtype=mean.dtype)
    return mean + noise @ torch.linalg.cholesky(covariance).T
