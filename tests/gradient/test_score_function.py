"""Stratified and leave-one-out estimators against exact enumeration over bins and over all draws."""

from __future__ import annotations

import itertools

import pytest
import torch

from neural_sim.gradient.estimators import across_lights, importance_weights, reinforce, stratified

DOUBLE = torch.float64
PSI = torch.tensor([0.3, -1.0, 0.8], dtype=DOUBLE)
SCORES = torch.tensor([2.0, -1.0, 0.5], dtype=DOUBLE)


def log_softmax(psi):
    return torch.log_softmax(psi, -1)


def floored(psi):
    return torch.log(0.85 * torch.softmax(psi, -1) + 0.05)


def exact(log_probabilities, means=SCORES, psi=PSI):
    leaf = psi.clone().requires_grad_()
    return torch.autograd.grad(log_probabilities(leaf).exp() @ means, leaf)[0]


@pytest.mark.parametrize("log_probabilities", [log_softmax, floored])
def test_stratified_is_exact_given_the_bins_means(log_probabilities):
    table = SCORES[:, None] + torch.tensor([[0.7, -0.7], [0.0, 0.0], [0.2, -0.2]], dtype=DOUBLE)
    found = stratified(table, PSI, log_probabilities, weight=0.25)
    torch.testing.assert_close(found.value, 0.25 * exact(log_probabilities))


def test_stratified_equals_the_closed_form_in_logits():
    p = torch.softmax(PSI, -1)
    found = stratified(SCORES[:, None], PSI, log_softmax)
    torch.testing.assert_close(found.value, p * (SCORES - p @ SCORES))
    assert float(found.value.sum().abs()) < 1e-15
    assert bool(found.standard_error.isinf().all())  # of one scene


def test_stratified_is_unbiased_and_its_standard_error_is_right(generator):
    """Scores of a bin, of a scene in all bins alike, and of both."""
    spread = torch.tensor([[0.5], [2.0], [1.0]], dtype=DOUBLE)
    runs = [
        stratified(
            SCORES[:, None]
            + 5.0 * torch.randn(1, 4, generator=generator, dtype=DOUBLE)
            + spread * torch.randn(3, 4, generator=generator, dtype=DOUBLE),
            PSI,
            log_softmax,
        )
        for _ in range(400)
    ]
    values = torch.stack([run.value for run in runs])
    error = values.std(0)
    assert bool(((values.mean(0) - exact(log_softmax)).abs() < 4 * error / 400**0.5).all())
    predicted = torch.stack([run.standard_error for run in runs]).square().mean(0).sqrt()
    # the sampled standard deviation of 400 runs is itself known to 1 / sqrt(800)
    torch.testing.assert_close(predicted, error, rtol=4 / 800**0.5, atol=0.0)


def test_what_a_scene_adds_in_all_bins_is_no_error(generator):
    common = torch.randn(1, 5, generator=generator, dtype=DOUBLE)
    found = stratified(SCORES[:, None] + 100.0 * common, PSI, log_softmax)
    torch.testing.assert_close(found.value, exact(log_softmax))
    assert float(found.standard_error.max()) < 1e-12


def test_one_bin_has_no_derivative():
    found = stratified(SCORES[None], torch.zeros(1, dtype=DOUBLE), log_softmax)
    assert found.value.tolist() == [0.0] and found.standard_error.tolist() == [0.0]


@pytest.mark.usefixtures("wrong_shapes")
@pytest.mark.parametrize("shape", [(3,), (2, 3), (3, 0), (3, 2, 1)])
def test_stratified_refuses_nonsense(shape):
    with pytest.raises(ValueError, match="stratified"):
        stratified(torch.ones(shape), PSI, log_softmax)


def test_importance_weights_restore_p():
    p = torch.tensor([0.7, 0.1, 0.2], dtype=DOUBLE)
    bins = torch.tensor([2, 0, 1, 1, 2, 2])
    weights = importance_weights(p, bins, weight=0.5)
    mass = torch.zeros(3, dtype=DOUBLE).index_add_(0, bins, weights)
    torch.testing.assert_close(mass, 0.5 * p)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("log_probabilities", [log_softmax, floored])
def test_reinforce_is_unbiased_over_all_draws(count, log_probabilities):
    p = log_probabilities(PSI).exp()
    expectation = torch.zeros_like(PSI)
    for outcome in itertools.product(range(3), repeat=count):
        bins = torch.tensor(outcome)
        found = reinforce(SCORES[bins], lambda psi, bins=bins: log_probabilities(psi)[bins], PSI, weight=2.0)
        expectation += p[bins].prod() * found.value
    torch.testing.assert_close(expectation, 2.0 * exact(log_probabilities))


def test_the_baseline_removes_a_constant():
    bins = torch.tensor([0, 1, 2, 2])
    for shift in (0.0, 1e3):
        found = reinforce(SCORES[bins] + shift, lambda psi: log_softmax(psi)[bins], PSI)
        torch.testing.assert_close(
            found.value, reinforce(SCORES[bins], lambda psi: log_softmax(psi)[bins], PSI).value
        )


def test_reinforce_refuses_nonsense():
    with pytest.raises(ValueError, match="at least 2"):
        reinforce(SCORES[:1], lambda psi: log_softmax(psi)[:1], PSI)
    with pytest.raises(ValueError, match="log-probabilities"):
        reinforce(SCORES, lambda psi: log_softmax(psi)[:2], PSI)


def test_what_a_scene_scores_under_every_light_is_no_error_of_differences_between_lights():
    lights, scenes = torch.tensor([1.0, -2.0, 4.0]).double(), torch.randn(5, dtype=torch.float64)
    common = across_lights(lights[:, None] + scenes, 2.0)
    torch.testing.assert_close(common.value, 2.0 * (lights - lights.mean()))
    torch.testing.assert_close(
        common.standard_error, torch.zeros(3, dtype=torch.float64), atol=1e-14, rtol=0.0
    )
    table = torch.randn(3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = across_lights(table, 2.0)
    differences = 2.0 * (table - table.mean(0))
    torch.testing.assert_close(found.value, differences.mean(1))
    torch.testing.assert_close(found.standard_error, differences.std(1) / 5**0.5)
