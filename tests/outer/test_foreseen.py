"""First-order gains against a loss that is linear in p, where first order is exact."""

import math

import pytest
import torch

from neural_sim.outer.foreseen import expected
from neural_sim.outer.settings import Checks
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution

NAMES = ("a", "b")
COST = torch.tensor([[0.3, 0.1, 0.5, 0.2], [0.2, 0.2, 0.2, 0.2]], dtype=torch.float64)


class Result:
    """A derivative by logits with the same standard error everywhere."""

    def __init__(self, gradient, error):
        self.psi_gradients = dict(zip(NAMES, gradient, strict=True))
        self.standard_errors = {name: torch.full_like(gradient[0], error) for name in NAMES}


@pytest.fixture
def distribution():
    return SceneDistribution.of([Pose(bins=4, floor=0.0)])


@pytest.fixture
def psi():
    return torch.tensor([[0.5, 0.0, -0.5, 0.2], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def derivative(psi):
    """Of sum_b cost_b p_b by logits."""
    p = psi.softmax(-1)
    return p * (COST - (p * COST).sum(-1, keepdim=True))


def gains(distribution, psi, error, trials=1, moved=0.2, radius=0.3, keep=0.0):
    results = [Result(derivative(psi), error) for _ in range(trials)]
    return expected(results, distribution, psi, NAMES, moved, Checks(radius=radius, largest=1.0, keep=keep))


def test_the_gain_of_a_bin_is_the_fall_of_a_linear_loss(distribution, psi):
    first, second = gains(distribution, psi, 1e-6)
    p = psi.softmax(-1)[0]
    for bin in range(4):
        after = 0.8 * p + 0.2 * torch.eye(4, dtype=torch.float64)[bin]
        assert first.by_bin[bin] == pytest.approx(float((p - after) @ COST[0]), abs=1e-12)
    assert first.p_value < 1e-10
    assert second.by_bin == pytest.approx([0.0] * 4, abs=1e-12) and second.p_value == pytest.approx(1.0)


def test_a_step_gains_what_the_loss_falls_by_within_its_radius(distribution, psi):
    first, second = gains(distribution, psi, 1e-6, radius=0.3)
    # No distribution within 0.3 of p has a lower loss than the one that moves 0.3 to bin 2 from the dearest bins.
    p = psi.softmax(-1)[0]
    best, left = 0.0, 0.3
    for bin in COST[0].argsort(descending=True).tolist():
        taken = min(left, float(p[bin])) if bin != 1 else 0.0
        best, left = best + taken * float(COST[0][bin] - COST[0][1]), left - taken
    assert 0.0 < first.step <= best + 1e-9 and first.step > 0.5 * best
    assert second.step == pytest.approx(0.0, abs=1e-9)


def test_a_step_gains_no_more_than_what_bins_may_lose(distribution, psi):
    p = psi.softmax(-1)[0]
    # All that may leave a bin goes to bin 1, the cheapest: the radius is as wide as p allows.
    most = sum(0.6 * float(p[bin]) * float(COST[0][bin] - COST[0][1]) for bin in (0, 2, 3))
    (first, _) = gains(distribution, psi, 1e-6, radius=1.0, keep=0.4)
    assert first.step == pytest.approx(most, rel=1e-3)


def test_errors_fall_with_the_root_of_the_trials(distribution, psi):
    (one, _), (four, _) = gains(distribution, psi, 0.01), gains(distribution, psi, 0.01, trials=4)
    assert four.by_bin_error == pytest.approx([0.5 * e for e in one.by_bin_error], rel=1e-9)
    assert four.by_bin == pytest.approx(one.by_bin, abs=1e-12) and four.step_error == pytest.approx(
        0.5 * one.step_error
    )
    # Moving 0.2 to bin 1: the change of p times each bin's error, 0.01 / p_b.
    p = psi.softmax(-1)[0]
    change = 0.2 * (torch.eye(4, dtype=torch.float64)[0] - p)
    assert one.by_bin_error[0] == pytest.approx(
        math.sqrt(float((change * 0.01 / p).square().sum())), rel=1e-9
    )
