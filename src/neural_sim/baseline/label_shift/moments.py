"""Weights of lights from a sample's mean: lights are no mixture of images, so moments are matched (pure functions).

All images of an object share one light. The network's guess y of the weights w is shrunk towards what it saw most, so
it is no estimate; but over held-out renders of known weights its mean is nearly linear, E[y | w] = B w, and the weights
are those whose mean is the target's (indirect inference, Gourieroux, Monfort and Renault 1993):

    w = argmin (ybar - B w)^T S^-1 (ybar - B w),    S = cov(ybar).
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
        scatter: covariance of a guess about B w.
        precision: inverse of the sum of w w^T over the different renders that B is from.
        misfit: covariance of what products of two weights explain of the rest: no number of boxes averages it out.
    """

    slope: Float[Tensor, "k k"]
    scatter: Float[Tensor, "k k"]
    precision: Float[Tensor, "k k"]
    misfit: Float[Tensor, "k k"]

    @staticmethod
    def of(guesses: Float[Tensor, "n k"], weights: Float[Tensor, "n k"]) -> Response:
        """Fit B by least squares on renders of known weights."""
        eye = torch.eye(weights.shape[1], dtype=weights.dtype)
        precision = torch.linalg.inv(weights.T @ weights + 1e-6 * eye)
        slope = (precision @ weights.T @ guesses).T
        left = guesses - weights @ slope.T
        scatter = left.T @ left / max(len(left) - weights.shape[1], 1)
        first, second = torch.triu_indices(weights.shape[1], weights.shape[1], 1)
        bent = weights[:, first] * weights[:, second]
        explained = bent @ torch.linalg.lstsq(bent, left).solution
        misfit = explained.T @ explained / max(len(left), 1)
        least = 1e-9 * scatter.diagonal().mean().clamp_min(1e-12) * eye
        several = len(weights) / len(weights.unique(dim=0))  # images of one render: they err alike
        return Response(slope, scatter + least, several * precision, misfit)

    def covariance(self, boxes: int, weights: Float[Tensor, "k"]) -> Float[Tensor, "k k"]:
        """Compute the covariance of the mean of ``boxes`` guesses less B w, which has errors of its own."""
        return self.scatter * (1.0 / boxes + weights @ self.precision @ weights) + self.misfit


def matched(
    mean: Float[Tensor, "*n k"],
    slope: Float[Tensor, "k k"],
    covariance: Float[Tensor, "k k"],
    project: Project,
    steps: int = 2000,
) -> Float[Tensor, "*n k"]:
    """Find the weights whose mean guess is nearest, by accelerated projected gradients (Beck and Teboulle 2009)."""
    inverse = torch.linalg.inv(covariance)
    inverse = inverse / inverse.diagonal().mean()
    quadratic = slope.T @ inverse @ slope
    linear = mean @ inverse @ slope
    rate = 1.0 / torch.linalg.eigvalsh(quadratic)[-1]
    w = project(torch.full_like(mean, 1.0 / mean.shape[-1]))
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
    mean: Float[Tensor, "*n k"],
    weights: Float[Tensor, "*n k"],
    slope: Float[Tensor, "k k"],
    covariance: Float[Tensor, "k k"],
) -> Float[Tensor, "*n"]:
    """Compute (ybar - B w)^T S^-1 (ybar - B w)."""
    left = mean - weights @ slope.T
    return (left @ torch.linalg.inv(covariance) * left).sum(-1)


def scattered(
    mean: Float[Tensor, "k"], covariance: Float[Tensor, "k k"], draws: int, generator: torch.Generator
) -> Float[Tensor, "draws k"]:
    """Draw means from the normal distribution about ``mean``."""
    noise = torch.randn(draws, len(mean), generator=generator, dtype=mean.dtype)
    return mean + noise @ torch.linalg.cholesky(covariance).T
