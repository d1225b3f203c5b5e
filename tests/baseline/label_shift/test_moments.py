"""Weights of lights by their moments, against least squares and a quadratic program."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from neural_sim.baseline.label_shift.moments import Response, distance, matched, scattered
from neural_sim.parameter.distributions import project_simplex

SLOPE = torch.tensor([[0.5, 0.1, 0.2], [0.2, 0.7, 0.1], [0.3, 0.2, 0.7]], dtype=torch.float64)


def renders(count, noise, seed=0):
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(count, 3, generator=generator, dtype=torch.float64).square()
    weights = weights / weights.sum(-1, keepdim=True)
    return weights @ SLOPE.T + noise * torch.randn(
        count, 3, generator=generator, dtype=torch.float64
    ), weights


def test_the_slope_and_the_scatter_are_those_of_the_renders():
    response = Response.of(*renders(5000, 0.1))
    torch.testing.assert_close(response.slope, SLOPE, atol=0.02, rtol=0.0)
    torch.testing.assert_close(response.scatter, 0.01 * torch.eye(3).double(), atol=5e-4, rtol=0.0)


def test_shrunk_guesses_give_the_weights_back():
    response = Response.of(*renders(2000, 0.05))
    truth = torch.tensor([0.9, 0.0, 0.1], dtype=torch.float64)
    found = matched(truth @ SLOPE.T, response.slope, response.covariance(50, truth), project_simplex)
    torch.testing.assert_close(found, truth, atol=0.02, rtol=0.0)


def test_the_weights_are_the_nearest_on_the_simplex():
    covariance = torch.diag(torch.tensor([1.0, 4.0, 0.5], dtype=torch.float64))
    means = torch.tensor([[1.2, 0.1, -0.1], [0.3, 0.4, 0.3]], dtype=torch.float64)
    found = matched(means, SLOPE, covariance, project_simplex)
    for mean, own in zip(means, found, strict=True):
        best = minimize(
            lambda w, mean=mean: float(distance(mean, torch.from_numpy(w), SLOPE, covariance)),
            np.full(3, 1 / 3), method="SLSQP", bounds=[(0, 1)] * 3, options={"ftol": 1e-14},
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
        )  # fmt: skip
        np.testing.assert_allclose(own.numpy(), best.x, atol=1e-5)


def test_draws_have_the_covariance_that_is_asked_for():
    drawn = scattered(torch.ones(3).double(), SLOPE @ SLOPE.T, 20000, torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.T.cov(), SLOPE @ SLOPE.T, atol=0.03, rtol=0.0)
    assert float(drawn.mean()) == pytest.approx(1.0, abs=0.03)
