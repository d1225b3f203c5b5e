"""Weights of lights by their moments, against least squares and a quadratic program."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from sklearn.linear_model import Ridge

from neural_sim.baseline.label_shift.moments import Response, distance, fitted, matched, scattered
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


def test_the_part_that_weights_explain_is_that_of_the_variance():
    assert Response.of(*renders(4000, 0.0)).explained == pytest.approx(1.0, abs=1e-4)
    guesses, weights = renders(4000, 0.1)
    left = 3 * 0.01 / float(guesses.var(0).sum())
    assert Response.of(guesses, weights).explained == pytest.approx(1.0 - left, abs=0.02)


def test_of_two_kinds_of_guesses_the_better_one_is_believed():
    """The second kind is exact; the first is noise, whatever the light."""
    exact, weights = renders(200, 0.0)
    noise = torch.rand(200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    response = Response.of(torch.cat([noise, exact], 1), weights)
    truth = torch.tensor([0.2, 0.7, 0.1], dtype=torch.float64)
    mean = torch.cat([torch.tensor([0.9, 0.1, 0.3], dtype=torch.float64), SLOPE @ truth])
    found = matched(mean, response.slope, response.covariance(50, truth), project_simplex)
    torch.testing.assert_close(found, truth, atol=0.01, rtol=0.0)


def test_guesses_that_no_weights_give_are_far():
    response = Response.of(*renders(2000, 0.05))
    guesses = torch.stack([SLOPE @ torch.tensor([0.3, 0.3, 0.4]).double(), torch.full((3,), 2.0).double()])
    near, far = response.misfits(guesses, project_simplex).tolist()
    assert near < 1.0 and far > 100.0


def test_the_scatter_of_guesses_is_not_averaged_out_by_boxes():
    """All boxes share one light: what the line misses of it is the same in all of them."""
    response, even = Response.of(*renders(5000, 0.1)), torch.full((3,), 1 / 3).double()
    torch.testing.assert_close(response.covariance(10**6, even), response.scatter, atol=1e-4, rtol=0.0)


def test_images_of_one_render_say_as_much_of_the_slope_as_one_of_them():
    """The error of B rests on the different lights: five images under each make it no smaller."""
    guesses, weights = renders(40, 0.1)
    expected = torch.linalg.inv(weights.T @ weights)
    for images in (1, 5):
        repeated = (values.repeat_interleave(images, 0) for values in (guesses, weights))
        torch.testing.assert_close(Response.of(*repeated).precision, expected, rtol=1e-5, atol=0.0)


def test_a_ridge_guesses_weights_that_are_linear_in_what_is_seen():
    seen, weights = renders(300, 0.0)
    torch.testing.assert_close(fitted(seen, weights, seen[:5], ridge=1e-9), weights[:5], atol=1e-4, rtol=0.0)
    inputs = torch.rand(20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scale = 20 * float((inputs - inputs.mean(0)).square().mean())
    reference = Ridge(alpha=0.1 * scale).fit(inputs.numpy(), weights[:20].numpy()).predict(inputs.numpy())
    np.testing.assert_allclose(fitted(inputs, weights[:20], inputs, ridge=0.1).numpy(), reference, atol=1e-9)


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
