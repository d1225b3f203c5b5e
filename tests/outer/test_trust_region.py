"""Where a step of a given length goes."""

import math

import pytest
import torch

from neural_sim.outer.trust_region import step_within
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.illumination import Illumination

POSE = BinnedFactor("pose", "phi", 4, 0.0, 2 * math.pi)
LIGHTS = Illumination(3)


def variation(factor, a, b):
    return 0.5 * (factor.p_of(a) - factor.p_of(b)).abs().sum(-1)


@pytest.mark.parametrize(("factor", "start"), [(POSE, [0.0, 3.0, 0.0, 0.0]), (LIGHTS, [0.2, 0.7, 0.1])])
def test_a_step_is_as_long_as_its_radius(factor, start):
    psi = torch.tensor([start, start], dtype=torch.float64)
    direction = torch.randn(psi.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    direction = direction - direction.mean(1, keepdim=True)
    radius = torch.tensor([0.1, 0.0], dtype=torch.float64)
    moved = step_within(factor, psi, direction, radius, keep=0.0)
    assert float(variation(factor, moved, psi)[0]) == pytest.approx(0.1, abs=1e-6)
    assert torch.equal(moved[1], psi[1])
    # The nearest p to p + t direction (Karush, Kuhn, Tucker): what remains is one number where p is not at its bound,
    # and no more than that where it is.
    p, change = factor.p_of(moved)[0], factor.p_of(moved)[0] - factor.p_of(psi)[0]
    free = p > p.min() + 1e-9 if factor is POSE else p > 1e-9
    slope = (change[free] - change[free].mean()) / (direction[0, free] - direction[0, free].mean())
    assert free.sum() >= 2 and float(slope.min()) > 0.0
    torch.testing.assert_close(slope, slope.mean().expand_as(slope))


def test_bins_that_are_as_good_as_each_other_gain_alike_whatever_their_p():
    p = torch.tensor([[0.85, 0.09, 0.01, 0.05]], dtype=torch.float64)
    direction = torch.tensor([[-0.6, 0.2, 0.2, 0.2]], dtype=torch.float64)
    change = (
        POSE.p_of(step_within(POSE, POSE.psi_of(p), direction, torch.tensor([0.6]).double(), keep=0.0)) - p
    )
    torch.testing.assert_close(
        change, torch.tensor([[-0.6, 0.2, 0.2, 0.2]], dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_a_step_leaves_each_bin_a_fraction_of_its_p():
    """What a bound keeps in one bin the others lose; the longest step ends with all bins but one at theirs."""
    p = torch.tensor([[0.4, 0.3, 0.2, 0.1]], dtype=torch.float64)
    psi, radius = POSE.psi_of(p), torch.tensor([0.2, 1.0], dtype=torch.float64)
    direction = torch.tensor([[0.5, -0.1, 0.0, -0.4]], dtype=torch.float64)
    near, far = (POSE.p_of(step_within(POSE, psi, direction, part[None], keep=0.4)) for part in radius)
    assert float(near[0, 3]) == pytest.approx(0.04)
    assert 0.5 * float((near - p).abs().sum()) == pytest.approx(0.2, abs=1e-6)
    unbounded = POSE.p_of(step_within(POSE, psi, direction, radius[:1], keep=0.0))
    assert float(unbounded[0, 3]) < 0.01 and float(near[0, 1]) < float(unbounded[0, 1])
    torch.testing.assert_close(
        far[0], torch.tensor([0.76, 0.12, 0.08, 0.04], dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_the_longest_step_ends_with_all_in_the_best_bin():
    psi = torch.zeros(1, 4, dtype=torch.float64)
    direction = torch.tensor([[-0.3, 0.3, 0.1, -0.1]], dtype=torch.float64)
    moved = step_within(POSE, psi, direction, torch.ones(1, dtype=torch.float64), keep=0.0)
    least = 0.005 * (5.0 - 4 * 0.005) / 4.0
    torch.testing.assert_close(
        POSE.p_of(moved)[0],
        torch.tensor([least, 1.0 - 3 * least, least, least], dtype=torch.float64),
        atol=1e-9,
        rtol=0,
    )
