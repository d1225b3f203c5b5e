"""Estimate the weights of lights by matching moments (pure functions).

All images of an object share one light, so they are not a mixture. Guesses y of the weights w are biased towards the
weights of common renders, and so are not estimates themselves; but over held-out renders of known weights, their mean
is nearly linear: E[y | w] = B w. The estimate is the w at which this mean is nearest to the mean guess of the target's
boxes, ybar (indirect inference, Gourieroux, Monfort and Renault 1993):

    w = argmin (ybar - B w)^T S^-1 (ybar - B w),    S = cov(ybar).

There are two guesses of each weight: the network's, and one that is linear in the colours of a crop's quarters, because
light is additive. S determines how far each is trusted; if the network was trained on few renders, the colours count
more. Covariances between the two are set to 0: otherwise the systematic errors of one would be used to correct the
other.
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

    Attributes:
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
        # Weights sum to 1 and guesses nearly do, so their scatter alone is nearly singular.
        least = (0.03 * scatter.diagonal()).clamp_min(1e-12).diag()
        # Images of one render have similar errors, and count once.
        several = len(weights) / len(weights.unique(dim=0))
        variance = float((guesses - guesses.mean(0)).square().sum())
        explained = 1.0 - float(left.square().sum()) / max(variance, 1e-12)
        return Response(slope, scatter + least, several * precision, explained)

    def covariance(self, boxes: int, weights: Float[Tensor, "k"]) -> Float[Tensor, "m m"]:
        """Compute the covariance of the mean of ``boxes`` guesses minus B w, including the error of B.

        The boxes share one light. The linear model's error at that light is the same for all of them and does not
        average out. The scatter of renders does not separate it from differences between boxes, so all of the scatter
        counts as both.
        """
        return self.scatter * (1.0 + 1.0 / boxes + weights @ self.precision @ weights)

    def misfits(self, guesses: Float[Tensor, "n m"], project: Project) -> Float[Tensor, "n"]:
        """Compute each guess's distance from the nearest B w, as in Hansen's test of overidentifying restrictions."""
        nearest = matched(guesses, self.slope, self.scatter, project)
        return distance(guesses, nearest, self.slope, self.scatter)


def fitted(
    inputs: Float[Tensor, "n d"],
    weights: Float[Tensor, "n k"],
    others: Float[Tensor, "m d"],
    ridge: float = 1e-3,
) -> Float[Tensor, "m k"]:
    """Guess the weights of ``others`` by ridge regression on the ``inputs`` of renders of known weights."""
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
    """Find the w whose B w is nearest to ``mean``, by accelerated projected gradients (Beck and Teboulle 2009)."""
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
    """Draw from the normal distribution with this mean and covariance."""
    noise = torch.randn(draws, len(mean), generator=generator, dtype=mean.dtype)
    return mean + noise @ torch.linalg.cholesky(covariance).T
