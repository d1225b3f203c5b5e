"""Steps of psi: closed forms, bounds, and descent on a known function."""

import math

import pytest
import torch

from neural_sim.parameter import bins as binned
from neural_sim.parameter.update import SGD, Mirror, UpdateState, bound, shrinkage


def test_bound_keeps_direction_and_limits_size():
    step = torch.tensor([[3.0, -1.0, -2.0], [0.1, 0.0, -0.1]], dtype=torch.float64)
    limited = bound(step, 0.5)
    assert limited[0].abs().max().item() == pytest.approx(0.5)
    torch.testing.assert_close(limited[0] / limited[0, 0], step[0] / step[0, 0])
    torch.testing.assert_close(limited[1], step[1])


def test_sgd_matches_torch():
    psi = torch.tensor([[0.3, -0.1, -0.2]], dtype=torch.float64)
    reference = torch.nn.Parameter(psi.clone())
    optimiser = torch.optim.SGD([reference], lr=0.01, momentum=0.9)
    update = SGD(learning_rate=0.01, momentum=0.9, max_step=10.0)
    state = UpdateState.zeros(psi)
    for gradient in torch.tensor(
        [[[1.0, -0.5, -0.5]], [[0.2, 0.3, -0.5]], [[0.0, 1.0, -1.0]]], dtype=torch.float64
    ):
        psi, state = update.step(psi, torch.log_softmax(psi, -1), gradient, torch.zeros_like(psi), state)
        reference.grad = gradient.clone()
        optimiser.step()
    torch.testing.assert_close(psi, reference.detach())


def test_sgd_without_a_bound_takes_the_whole_step():
    """Under a constant gradient g the n-th velocity is g (1 - 0.9^n) / 0.1, and psi has moved by the sum of them."""
    psi = torch.tensor([[0.3, -0.1, -0.2]], dtype=torch.float64)
    gradient = torch.tensor([[40.0, -50.0, 10.0]], dtype=torch.float64)
    update, state, moved = SGD(learning_rate=3.0, momentum=0.9), UpdateState.zeros(psi), psi
    for _ in range(5):
        moved, state = update.step(moved, psi.log_softmax(-1), gradient, torch.full_like(psi, 1e9), state)
    velocities = sum((1.0 - 0.9**n) / 0.1 for n in range(1, 6))
    torch.testing.assert_close(moved, psi - 3.0 * velocities * gradient)


def test_mirror_step_is_exponentiated_gradient():
    """Without momentum, p_new is proportional to p exp(-eta dL/dp)."""
    log_p = torch.log_softmax(torch.tensor([[0.5, -1.0, 0.2]], dtype=torch.float64), -1)
    slope = torch.tensor([[0.3, -0.2, 0.9]], dtype=torch.float64)
    p = log_p.exp()
    gradient = p * (slope - (p * slope).sum())
    update = Mirror(learning_rate=0.05, momentum=0.0, max_step=10.0)
    moved, _ = update.step(log_p, log_p, gradient, torch.zeros_like(log_p), UpdateState.zeros(log_p))
    centred = slope - slope.mean()
    eta = 0.05 / centred.square().mean().sqrt()
    expected = torch.softmax(log_p - eta * slope, -1)
    torch.testing.assert_close(torch.softmax(moved, -1), expected)


@pytest.mark.parametrize("update", [SGD(learning_rate=2.0, max_step=0.5), Mirror()])
def test_each_finds_the_best_bin(update):
    cost = torch.tensor([[0.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 1.0]], dtype=torch.float64)
    psi = torch.log(torch.tensor([[0.02, 0.94, 0.02, 0.02]], dtype=torch.float64)).repeat(2, 1)
    state = UpdateState.zeros(psi)
    for _ in range(40):
        log_p = torch.log_softmax(psi, -1)
        gradient = log_p.exp() * (cost - (log_p.exp() * cost).sum(-1, keepdim=True))
        psi, state = update.step(psi, log_p, gradient, torch.zeros_like(psi), state)
    assert psi.argmax(-1).tolist() == [0, 2]


@pytest.mark.parametrize("update", [SGD(learning_rate=1e3, max_step=0.5), SGD(learning_rate=1e3), Mirror()])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e308])
def test_a_gradient_that_is_not_finite_is_refused_and_forgotten(update, bad):
    psi = torch.tensor([[0.3, -0.1, -0.2]], dtype=torch.float64)
    log_p, none = torch.log_softmax(psi, -1), torch.zeros_like(psi)
    good = torch.tensor([[0.2, -0.3, 0.1]], dtype=torch.float64)
    start = update.step(psi, log_p, good, none, UpdateState.zeros(psi))[1]
    poisoned = torch.tensor([[bad, 1.0, -1.0]], dtype=torch.float64)
    kept, state = update.step(psi, log_p, poisoned, none, start)
    assert torch.equal(kept, psi) and state.refused == 1
    after, _ = update.step(kept, log_p, good, none, state)
    expected, _ = update.step(psi, log_p, good, none, start)
    assert torch.equal(after, expected)


@pytest.mark.parametrize("size", [math.inf, math.nan, 1e200])
def test_an_unknown_noise_shrinks_nothing_and_is_forgotten(size):
    update, psi = Mirror(), torch.zeros(1, 3, dtype=torch.float64)
    log_p, gradient = torch.log_softmax(psi, -1), torch.tensor([[0.2, -0.3, 0.1]], dtype=torch.float64)
    unknown = torch.full_like(psi, size)
    moved, state = update.step(psi, log_p, gradient, unknown, UpdateState.zeros(psi))
    unshrunk, _ = update.step(psi, log_p, gradient, torch.zeros_like(psi), UpdateState.zeros(psi))
    assert torch.equal(moved, unshrunk)
    stays, _ = update.step(psi, log_p, gradient, torch.full_like(psi, 1e6), state)
    assert torch.equal(stays, psi)


def test_directions_are_shrunk_by_what_is_noise():
    direction = torch.tensor([[3.0, -4.0, 0.5], [0.0, 2.0, 1.0]], dtype=torch.float64)
    variance = torch.tensor([[2.0, 4.0, 1.0], [1.0, torch.inf, 0.0]], dtype=torch.float64)
    expected = torch.tensor([[7.0 / 9.0, 0.75, 0.0], [0.0, 1.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(shrinkage(direction, variance), expected)


def test_mirror_step_shrinks_components_within_their_noise():
    """One object's gradient has a mean, the others' are noise of the stated size.

    A shrunk standard normal has the root mean square sqrt(1/3), which is by how much a random walk gets shorter.
    """
    generator = torch.Generator().manual_seed(0)
    mean = torch.zeros(33, 8, dtype=torch.float64)
    mean[0, 0] = -0.1
    noise = 0.1 * torch.randn(30, 33, 8, generator=generator, dtype=torch.float64)
    drift = {}
    for shrink in (True, False):
        update, psi = Mirror(learning_rate=0.05, momentum=0.0, shrink=shrink), torch.zeros_like(mean)
        state = UpdateState.zeros(psi)
        for draw in noise:
            p = torch.softmax(psi, -1)
            psi, state = update.step(psi, p.log(), p * (mean + draw), 0.1 * p, state)
        assert psi[0].argmax() == 0
        drift[shrink] = psi[1:].square().mean().sqrt()
    assert 0.45 < drift[True] / drift[False] < 0.7


def test_the_noise_of_a_momentum_is_that_of_the_weighted_sum_of_gradients():
    """After n gradients of the same error, the weights are (1 - m) m^j: their squares are a geometric series."""
    update, psi = Mirror(momentum=0.6), torch.zeros(1, 3, dtype=torch.float64)
    log_p = torch.tensor([[0.5, 0.3, 0.2]], dtype=torch.float64).log()
    gradient, error = torch.tensor([[0.2, -0.3, 0.1], [0.02, 0.01, 0.03]], dtype=torch.float64)[:, None]
    state = UpdateState.zeros(psi)
    for taken in range(1, 5):
        _, state = update.step(psi, log_p, gradient, error, state)
        weights = 0.4 * 0.6 ** torch.arange(taken, dtype=torch.float64)
        torch.testing.assert_close(state.noise, weights.square().sum() * (error / log_p.exp()).square())


def test_mirror_goes_on_after_a_cliff():
    """One gradient of 1e12 among ordinary ones costs steps of a tenth, not all that follow."""
    update, psi = Mirror(learning_rate=0.3, momentum=0.5), torch.zeros(1, 4, dtype=torch.float64)
    state, exact = UpdateState.zeros(psi), torch.zeros_like(psi)
    slope = torch.tensor([[-1.0, 0.5, 0.25, 0.25]], dtype=torch.float64)
    for step in range(60):
        p = torch.softmax(psi, -1)
        size = 1e12 if step == 5 else 1.0
        psi, state = update.step(psi, p.log(), size * p * (slope - (p * slope).sum()), exact, state)
        if step == 45:  # momentum has forgotten the cliff: 1e12 * 0.5^40 = 1
            before = psi.clone()
    assert (psi - before)[0, 0] > 13 * 0.3 / 10


def test_a_mirror_step_of_an_object_with_closed_bins_is_that_without_them():
    """The other object, which has none, steps as well."""
    p = torch.tensor([[0.0, 0.6, 0.4, 0.0], [0.1, 0.2, 0.3, 0.4]], dtype=torch.float64)
    closed = p == 0.0
    psi = binned.logits(p, 0.0, closed)
    slope = torch.tensor([[9.0, 0.5, -0.5, 9.0], [0.3, -0.2, 0.9, 0.0]], dtype=torch.float64)
    gradient = p * (slope - (p * slope).sum(-1, keepdim=True))
    update = Mirror(learning_rate=0.1, momentum=0.0)
    moved, state = update.step(
        psi, binned.log_slopes(psi), gradient, torch.zeros_like(psi), UpdateState.zeros(psi)
    )
    assert state.refused == 0 and torch.equal(binned.is_closed(moved), closed)
    new = binned.log_probabilities(moved).exp()
    centred = slope[1] - slope[1].mean()
    eta = 0.1 / math.sqrt((0.5 + centred.square().sum()) / 8.0)
    expected = p * torch.exp(-eta * torch.where(closed, 0.0, slope))
    torch.testing.assert_close(new, expected / expected.sum(-1, keepdim=True))
