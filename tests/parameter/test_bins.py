"""Gumbel-softmax bins against closed forms, enumeration and central differences."""

import math

import pytest
import torch
from scipy.optimize import minimize

from neural_sim.parameter import bins as binned


def test_logits_invert_log_probabilities():
    p = torch.tensor([0.86, 0.02, 0.05, 0.07], dtype=torch.float64)
    for floor in (0.0, 0.005):
        back = binned.log_probabilities(binned.logits(p, floor), floor).exp()
        torch.testing.assert_close(back, p, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("floor", [0.0, 0.005])
def test_log_slopes_turn_derivatives_by_p_into_those_by_logits(floor, generator):
    psi = torch.tensor(
        [[3.0, 0.0, -12.0, 1.0], [0.1, -0.2, 0.3, 0.0]], dtype=torch.float64, requires_grad=True
    )
    by_p = torch.randn(2, 4, generator=generator, dtype=torch.float64)
    (by_logits,) = torch.autograd.grad((by_p * binned.log_probabilities(psi, floor).exp()).sum(), psi)
    scale = binned.log_slopes(psi.detach(), floor).exp()
    mean = (scale * by_p).sum(-1, keepdim=True) / scale.sum(-1, keepdim=True)
    torch.testing.assert_close(by_logits, scale * (by_p - mean), rtol=1e-9, atol=1e-18)


def test_bounded_logits_keep_p_near_the_floor():
    psi = torch.tensor([4.0, -20.0, 1.0, 0.0], dtype=torch.float64)
    near = binned.bounded(psi, 0.005)
    assert torch.equal(near[[0, 2, 3]], psi[[0, 2, 3]]) and torch.equal(binned.bounded(near, 0.005), near)
    p = binned.log_probabilities(near, 0.005).exp()
    assert 0.005 < float(p[1]) < 1.25 * 0.005
    assert torch.equal(binned.bounded(psi, 0.0), psi)


def test_nearest_probabilities_are_the_point_itself_or_the_nearest_of_many(generator):
    p = torch.tensor([0.6, 0.2, 0.15, 0.05], dtype=torch.float64)
    torch.testing.assert_close(binned.nearest(p, 0.005), p)
    far = torch.tensor([1.4, 0.3, -0.2, -0.5], dtype=torch.float64)
    near, least = binned.nearest(far, 0.005), 0.005 + 0.25 * 0.005 * 0.98
    torch.testing.assert_close(near.sum(), torch.ones((), dtype=torch.float64))
    assert float(near.min()) == pytest.approx(least)
    others = torch.rand(10000, 4, generator=generator, dtype=torch.float64)
    others = least + (1.0 - 4 * least) * others / others.sum(1, keepdim=True)
    others = torch.cat([others, near + 0.01 * (others - near)])
    assert bool(((others - far).norm(dim=1) >= (near - far).norm()).all())
    at_bound = binned.bounded(torch.tensor([0.0, -50.0, -50.0, -50.0], dtype=torch.float64), 0.005)
    assert float(binned.log_probabilities(at_bound, 0.005).exp().min()) == pytest.approx(least, rel=5e-3)


def test_nearest_probabilities_above_bounds_of_their_own_agree_with_a_solver(generator):
    least = torch.tensor([0.3, 0.02, 0.1, 0.001, 0.05], dtype=torch.float64)
    for _ in range(5):
        far = torch.randn(5, generator=generator, dtype=torch.float64)
        near = binned.nearest(far, 0.005, least)
        lowest = least.clamp_min(0.005 + 0.25 * 0.005 * 0.975).numpy()
        solved = minimize(
            lambda p, to: ((p - to) ** 2).sum(), lowest + (1.0 - lowest.sum()) / 5, args=(far.numpy(),),
            bounds=[(low, 1.0) for low in lowest], constraints={"type": "eq", "fun": lambda p: p.sum() - 1.0},
            options={"ftol": 1e-14, "maxiter": 1000},
        )  # fmt: skip
        torch.testing.assert_close(near, torch.as_tensor(solved.x), atol=1e-5, rtol=0)


def test_balanced_draws_have_the_bins_expected_numbers_and_each_follows_p(generator):
    p = torch.tensor([0.47, 0.3, 0.17, 0.05, 0.01], dtype=torch.float64)
    n, trials = 20, 4_000
    first = torch.zeros(5, dtype=torch.float64)
    counts = torch.zeros(trials, 5, dtype=torch.float64)
    for trial in range(trials):
        noise = binned.gumbel((n, 5), generator, torch.float64)
        drawn = binned.balanced(p.log(), noise, float(torch.rand((), generator=generator)))
        first[drawn[0]] += 1.0 / trials
        counts[trial] = torch.bincount(drawn, minlength=5)
    assert ((counts - n * p).abs() < 1.0).all() and (counts.sum(1) == n).all()
    torch.testing.assert_close(counts.mean(0), n * p, rtol=0.0, atol=4 * 0.5 / trials**0.5)
    assert ((first - p).abs() < 4 * (p * (1 - p) / trials).sqrt()).all()


def test_balanced_draws_that_are_balanced_already_stay_and_few_follow_a_small_change(generator):
    noise = binned.gumbel((200, 8), generator, torch.float64)
    uniform = torch.full((8,), 1 / 8, dtype=torch.float64)
    before = binned.balanced(uniform.log(), noise, 0.5)
    moved = 0.9 * uniform
    moved[2] += 0.1
    after = binned.balanced(moved.log(), noise, 0.5)
    assert 0.1 * 7 / 8 - 0.02 <= float((before != after).double().mean()) < 0.2
    free = noise.argmax(-1)
    wanted = torch.bincount(free, minlength=8).double() / 200
    settled = binned.balanced(wanted.log(), noise - wanted.log(), 0.5)
    assert torch.equal(settled, free)


def test_balanced_draws_of_what_is_not_a_number_are_refused(generator):
    noise = binned.gumbel((6, 3), generator, torch.float64)
    with pytest.raises(ValueError, match="finite psi"):
        binned.balanced(torch.tensor([math.nan, 0.0, 0.0]), noise, 0.5)


def test_floor_out_of_range_is_refused():
    with pytest.raises(ValueError, match="floor"):
        binned.log_probabilities(torch.zeros(4), 0.25)


def test_the_bin_of_an_angle_is_that_of_its_direction():
    angle = torch.linspace(0.01, 2.0 * math.pi - 0.01, 50, dtype=torch.float64)
    wanted = (angle // (math.pi / 4)).long()
    for turns in (-2, -1, 0, 1, 3):
        assert torch.equal(binned.nearest_bin(angle + 2.0 * math.pi * turns, 8, 0.0, 2.0 * math.pi), wanted)


def test_linear_mean_of_opposite_wrap_bins_lands_on_the_far_side():
    centre = binned.centres(8, 0.0, 2 * math.pi, torch.zeros(1, dtype=torch.float64))
    y = torch.zeros(8, dtype=torch.float64)
    y[[0, 7]] = 0.5
    assert binned.linear_mean(y, centre).item() == pytest.approx(math.pi)
    assert math.cos(binned.circular_mean(y, centre).item()) == pytest.approx(1.0)


def test_circular_mean_is_shift_equivariant(generator):
    centre = binned.centres(8, 0.0, 2 * math.pi, torch.zeros(1, dtype=torch.float64))
    y = torch.softmax(2 * torch.randn(50, 8, generator=generator, dtype=torch.float64), -1)
    shifted = binned.circular_mean(y.roll(3, -1), centre)
    expected = binned.circular_mean(y, centre) + 3 * 2 * math.pi / 8
    assert torch.cos(shifted - expected).min() > 1 - 1e-12


def test_circular_mean_derivative_against_central_differences(generator):
    centre = binned.centres(5, 0.0, 2 * math.pi, torch.zeros(1, dtype=torch.float64))
    y = torch.softmax(2 * torch.randn(5, generator=generator, dtype=torch.float64), -1).requires_grad_()
    assert torch.hypot(y @ centre.sin(), y @ centre.cos()) > 0.1
    (gradient,) = torch.autograd.grad(binned.circular_mean(y, centre), y)
    step = 1e-6
    for i in range(5):
        e = torch.zeros(5, dtype=torch.float64)
        e[i] = step
        slope = (binned.circular_mean(y + e, centre) - binned.circular_mean(y - e, centre)) / (2 * step)
        assert gradient[i].item() == pytest.approx(slope.item(), rel=1e-7)


def test_one_bin_always_wins(generator):
    y = binned.gumbel_softmax(torch.zeros(1), binned.gumbel((5, 1), generator, torch.float32), 0.1)
    assert (y == 1).all()


def closed_psi():
    psi = torch.tensor([[0.3, -0.2, 1.0, 0.5], [0.0, 2.0, -1.0, 0.1]], dtype=torch.float64)
    closed = torch.tensor([[False, True, False, True], [False, False, False, False]])
    return binned.closing(psi, closed), psi, closed


@pytest.mark.parametrize("floor", [0.0, 0.02])
def test_closed_bins_have_no_probability_and_the_others_are_those_without_them(floor):
    """A row with closed bins against the same logits without these; one without any is untouched."""
    psi, before, _ = closed_psi()
    p = binned.log_probabilities(psi, floor).exp()
    assert p[0, [1, 3]].tolist() == [0.0, 0.0]
    torch.testing.assert_close(p[0, [0, 2]], binned.log_probabilities(before[0, [0, 2]], floor).exp())
    torch.testing.assert_close(p[1], binned.log_probabilities(before[1], floor).exp())
    back = binned.logits(p, floor, binned.is_closed(psi))
    torch.testing.assert_close(binned.log_probabilities(back, floor).exp(), p)
    slopes = torch.autograd.functional.jacobian(lambda x: binned.log_probabilities(x, floor).exp(), psi[0])
    assert bool(slopes.isfinite().all()) and not slopes[[1, 3]].any() and not slopes[:, [1, 3]].any()


def test_no_step_opens_a_closed_bin(generator):
    psi, _, closed = closed_psi()
    assert torch.equal(binned.is_closed(binned.bounded(psi + 3.0, 0.01)), closed)
    p = binned.log_probabilities(psi, 0.01).exp()
    moved = binned.nearest(p + torch.tensor([-0.3, 0.5, 0.1, 0.2]), 0.01, 0.1 * p, closed)
    torch.testing.assert_close(moved.sum(-1), torch.ones(2, dtype=torch.float64))
    assert moved[0, [1, 3]].tolist() == [0.0, 0.0] and float(moved.min()) >= 0.0
    alone = binned.nearest((p[0] + torch.tensor([-0.3, 0.5, 0.1, 0.2]))[[0, 2]], 0.01, 0.1 * p[0, [0, 2]])
    torch.testing.assert_close(
        moved[0, [0, 2]], alone, atol=2e-3, rtol=0.0
    )  # the least p is of four bins, not two
    log_p = binned.log_probabilities(psi[0], 0.01)
    gumbel = binned.gumbel((400, 4), generator, torch.float64)
    assert not set(binned.balanced(log_p, gumbel, 0.3).tolist()) & {1, 3}
    assert not set((log_p + gumbel).argmax(-1).tolist()) & {1, 3}
    assert float(binned.gumbel_softmax(log_p, gumbel, 0.1)[:, [1, 3]].max()) == 0.0
