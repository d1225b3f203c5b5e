"""The steps as functions against torch's own optimiser, and their pull-back against the formulas written out."""

import pytest
import torch

from neural_sim.detector.optimiser import AdamW, pulled_back

DOUBLE = torch.float64
RATES = (1e-3, 1e-2, 7e-3, 2e-3)
PAIRS = [
    (AdamW(0.02), lambda p: torch.optim.AdamW(p, lr=1.0, weight_decay=0.02)),
    (AdamW(0.0, (0.8, 0.99), 1e-3), lambda p: torch.optim.AdamW(p, 1.0, (0.8, 0.99), 1e-3, 0.0)),
]


@pytest.mark.parametrize(("rule", "theirs"), PAIRS, ids=["default", "changed"])
def test_steps_are_those_of_torch(generator, rule, theirs):
    start = torch.randn(9, generator=generator, dtype=DOUBLE)
    value = torch.nn.Parameter(start.clone())
    optimiser, state = theirs([value]), rule.begin(start)
    for done, rate in enumerate(RATES):
        gradient = torch.randn(9, generator=generator, dtype=DOUBLE)
        gradient[0] = 0.0
        state = rule.step(state, gradient, rate, done)
        value.grad = gradient.clone()
        optimiser.param_groups[0]["lr"] = rate
        optimiser.step()
        torch.testing.assert_close(state[0], value.detach(), rtol=1e-13, atol=1e-15)


def test_a_weight_decay_for_each_entry_is_that_of_parameter_groups(generator):
    start, gradient = torch.randn(2, 6, generator=generator, dtype=DOUBLE)
    value = [torch.nn.Parameter(part.clone()) for part in start.split(3)]
    groups = [{"params": [value[0]], "weight_decay": 0.3}, {"params": [value[1]], "weight_decay": 0.0}]
    for part, slope in zip(value, gradient.split(3), strict=True):
        part.grad = slope.clone()
    torch.optim.AdamW(groups, lr=0.1).step()
    rule = AdamW(torch.tensor([0.3] * 3 + [0.0] * 3, dtype=DOUBLE))
    ours = rule.step(rule.begin(start), gradient, 0.1, 0)[0]
    torch.testing.assert_close(ours, torch.cat([part.detach() for part in value]), rtol=1e-13, atol=1e-15)


def test_adamws_pull_back_is_the_formula_written_out(generator):
    rate, decay, done, (fast, slow), eps = 7e-3, 0.02, 4, (0.9, 0.999), 1e-3
    theta, first, gradient, by_theta, by_first, by_second = torch.randn(
        6, 9, generator=generator, dtype=DOUBLE
    )
    second = torch.rand(9, generator=generator, dtype=DOUBLE)
    rule = AdamW(decay, (fast, slow), eps)
    earlier, along = pulled_back(
        rule, (theta, first, second), gradient, rate, done, (by_theta, by_first, by_second)
    )
    c1, c2 = 1 - fast ** (done + 1), 1 - slow ** (done + 1)
    m, v = fast * first + (1 - fast) * gradient, slow * second + (1 - slow) * gradient**2
    root = (v / c2).sqrt()
    a_m = by_first - rate * by_theta / (c1 * (root + eps))
    a_v = by_second + rate * by_theta * (m / c1) / (2 * c2 * root * (root + eps) ** 2)
    torch.testing.assert_close(along, (1 - fast) * a_m + 2 * (1 - slow) * gradient * a_v)
    torch.testing.assert_close(earlier[0], (1 - rate * decay) * by_theta)
    torch.testing.assert_close(earlier[1], fast * a_m)
    torch.testing.assert_close(earlier[2], slow * a_v)


def test_an_entry_that_never_had_a_gradient_has_a_finite_pull_back():
    """There the step is m / (c1 eps): its derivative by the gradient is -rate / eps, by the second moment none."""
    rule, zero = AdamW(0.0), torch.zeros(1, dtype=DOUBLE)
    one = torch.ones(1, dtype=DOUBLE)
    earlier, along = pulled_back(rule, rule.begin(one), zero, 1e-2, 0, (one, zero, zero))
    assert float(along) == pytest.approx(-1e-2 / 1e-8, rel=1e-12)
    assert float(earlier[2]) == 0.0


def test_a_floor_under_adamws_denominator_bounds_its_pull_back(generator):
    """Where the floor holds, a step is rate m / (c1 floor): the second moment has no effect on theta."""
    rate, done, (fast, slow) = 7e-3, 2, (0.9, 0.999)
    theta, first, gradient, by_theta = torch.randn(4, 6, generator=generator, dtype=DOUBLE)
    second, end = torch.rand(2, 6, generator=generator, dtype=DOUBLE)
    second[:3] = first[:3] = gradient[:3] = 0.0
    plain = AdamW(0.02)
    usual = (end / (1 - slow**120)).sqrt()
    rule = plain.floored((theta, first, end), 120, 1e-2, [1] * 6)
    torch.testing.assert_close(rule.floor, 1e-2 * (usual + plain.eps))
    still = torch.zeros_like(theta)
    (_, by_first, by_second), along = pulled_back(
        rule, (theta, first, second), gradient, rate, done, (by_theta, still, still)
    )
    pushed = -rate * by_theta[:3] / ((1 - fast ** (done + 1)) * rule.floor[:3])
    torch.testing.assert_close(by_first[:3], fast * pushed)
    torch.testing.assert_close(along[:3], (1 - fast) * pushed)
    assert not by_second[:3].any() and by_second[3:].all()
    _, exact = pulled_back(plain, (theta, first, second), gradient, rate, done, (by_theta, still, still))
    torch.testing.assert_close(along[3:], exact[3:])


def test_a_rule_without_a_floor_is_itself():
    state = (torch.ones(2), torch.ones(2), torch.ones(2))
    assert AdamW().floored(state, 3, 0.0, [2]) == AdamW()


def test_an_entry_without_usual_gradients_takes_the_level_of_its_tensor():
    """The root mean square of the tensor's denominators, where the entry's own is smaller."""
    end = torch.tensor([1e-14, 9.0, 16.0, 4.0], dtype=DOUBLE).square()
    state = (torch.zeros_like(end), torch.zeros_like(end), end * (1 - 0.999**50))
    rule = AdamW().floored(state, 50, 0.3, [3, 1])
    level = ((81 + 256) / 3) ** 0.5
    wanted = 0.3 * torch.tensor([level, level, 16.0, 4.0], dtype=DOUBLE)
    torch.testing.assert_close(rule.floor, wanted, rtol=1e-7, atol=0.0)
