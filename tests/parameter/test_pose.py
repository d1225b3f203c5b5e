"""Pose draws: the right bins, replay, and the derivative of the relaxed draw."""

import dataclasses
import math

import pytest
import torch
from scipy.integrate import quad

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import SceneDraw


def drawn(bins):
    """A draw of which only the bins matter."""
    still = torch.zeros(len(bins))
    return SceneDraw(still, still, still, bins)


def only(**settings):
    """p_psi of a run that learns nothing but the pose."""
    return SceneDistribution.of([Pose(**settings)])


def test_hard_draws_lie_in_their_bins_and_follow_p(generator):
    pose = only(floor=0.0)
    (p,) = pose.probabilities(pose.psi("initial", ["any"]))["pose"]
    noise = pose.draw_noise(8_000, generator, torch.float64)
    draw = pose.hard(pose.psi("initial", ["any"])[0], noise)
    assert torch.equal(pose.bins_of(draw), draw.bins)
    share = draw.bins[:, 0].bincount(minlength=8) / 8_000
    assert (share - p).abs().max() < 4 * math.sqrt(0.125 * 0.875 / 8_000)
    assert draw.rho.abs().max() <= math.pi / 4 and draw.distance.min() >= 2.4 and draw.distance.max() <= 4.0


def test_same_noise_same_draw(generator):
    pose = only()
    noise = pose.draw_noise(10, generator)
    psi = pose.psi("initial", ["x"])[0].float()
    assert torch.equal(pose.relaxed(psi, noise).phi, pose.relaxed(psi, noise).phi)


def test_relaxed_tends_to_hard_as_temperature_falls(generator):
    pose = only(temperature=1e-4)
    psi = torch.randn(8, generator=generator, dtype=torch.float64)
    noise = pose.draw_noise(200, generator, torch.float64)
    hard, relaxed = pose.hard(psi, noise), pose.relaxed(psi, noise)
    assert torch.equal(hard.bins, relaxed.bins)
    assert torch.cos(hard.phi - relaxed.phi).quantile(0.05) > 1 - 1e-9


@pytest.mark.parametrize("bin_mean", ["linear", "circular"])
def test_relaxed_derivative_against_central_differences(bin_mean, generator):
    pose = only(temperature=1.0, bin_mean=bin_mean)
    psi = torch.randn(8, generator=generator, dtype=torch.float64, requires_grad=True)
    noise = pose.draw_noise(6, generator, torch.float64)
    cotangent = torch.randn(6, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad(pose.relaxed(psi, noise).phi @ cotangent, psi)
    step = 1e-6
    for i in range(8):
        e = torch.zeros(8, dtype=torch.float64)
        e[i] = step
        with torch.no_grad():
            slope = (pose.relaxed(psi + e, noise).phi - pose.relaxed(psi - e, noise).phi) @ cotangent
        assert gradient[i].item() == pytest.approx(slope.item() / (2 * step), rel=1e-6, abs=1e-9)


def _contributions(pose, psi, noise, relaxation, cotangent):
    """Every draw's part in the derivative of sum_i f(phi_i), with f' = ``cotangent``."""
    slopes = cotangent(pose.relaxed(psi, noise, relaxation).phi.detach())
    columns = [
        torch.func.jvp(lambda at: pose.relaxed(at, noise, relaxation).phi, (psi.detach(),), (e,))[1]
        for e in torch.eye(len(psi), dtype=psi.dtype)
    ]
    return slopes[:, None] * torch.stack(columns, -1)


@pytest.mark.parametrize("bin_mean", ["linear", "circular"])
def test_straight_through_is_the_hard_draw_with_the_relaxed_slope(bin_mean, generator):
    pose = only(temperature=0.7, bin_mean=bin_mean)
    psi = torch.randn(8, generator=generator, dtype=torch.float64, requires_grad=True)
    noise = pose.draw_noise(20, generator, torch.float64)
    hard, through = pose.hard(psi, noise), pose.relaxed(psi, noise, "straight_through")
    assert torch.equal(hard.bins, through.bins)
    torch.testing.assert_close(through.phi, hard.phi, rtol=1e-14, atol=0.0)
    ones = torch.ones_like
    expected = _contributions(pose, psi, noise, "gumbel_softmax", ones)
    torch.testing.assert_close(_contributions(pose, psi, noise, "straight_through", ones), expected)


@pytest.mark.parametrize("bin_mean", ["linear", "circular"])
def test_gumbel_rao_has_the_mean_of_straight_through_and_less_variance(bin_mean, generator):
    pose = only(bins=4, temperature=0.3, bin_mean=bin_mean, floor=0.01)
    psi = torch.tensor([0.5, -0.5, 1.0, 0.0], dtype=torch.float64, requires_grad=True)
    count = 4_000
    noise = pose.draw_noise(count, generator, torch.float64, conditional=16)
    draw = pose.relaxed(psi, noise, "gumbel_rao")
    torch.testing.assert_close(draw.phi, pose.hard(psi, noise).phi, rtol=1e-14, atol=0.0)

    def slope(phi):
        return torch.cos(2.0 * phi) + 0.5 * phi

    through = _contributions(pose, psi, noise, "straight_through", slope)
    averaged = _contributions(pose, psi, noise, "gumbel_rao", slope)
    difference = (through - averaged).mean(0)
    error = (through - averaged).std(0) / count**0.5
    assert (difference.abs() < 4 * error).all()
    assert (averaged.var(0).sum() < 0.7 * through.var(0).sum()).all()


def test_gumbel_rao_equals_the_integral_over_the_noise_given_the_bin(generator):
    """Two bins: the difference of perturbed logits is logistic about psi_0 - psi_1, cut off at 0 by the choice."""
    tau, gap = 0.5, 0.8
    pose = only(bins=2, temperature=tau, bin_mean="linear", floor=0.0)
    psi = torch.tensor([gap, 0.0], dtype=torch.float64, requires_grad=True)
    noise = pose.draw_noise(2, generator, torch.float64, conditional=100_000)
    gumbel = torch.tensor([[9.0, 0.0], [0.0, 9.0]], dtype=torch.float64)
    held = dataclasses.replace(noise.bins["pose"], gumbel=gumbel)
    noise = dataclasses.replace(noise, bins={"pose": held})
    found = _contributions(pose, psi, noise, "gumbel_rao", torch.ones_like)[:, 0]

    def integrand(x):
        share = 1.0 / (1.0 + math.exp(-x / tau))
        density = math.exp(-abs(x - gap)) / (1.0 + math.exp(-abs(x - gap))) ** 2
        return (0.5 - 1.5) * math.pi * share * (1.0 - share) / tau * density

    p = 1.0 / (1.0 + math.exp(-gap))
    expected = [quad(integrand, 0.0, 40.0)[0] / p, quad(integrand, -40.0, 0.0)[0] / (1.0 - p)]
    # standard errors of 100,000 draws of a number in (-pi / 4 tau, 0)
    assert found.tolist() == pytest.approx(expected, abs=5 * math.pi / (8 * tau) / 100_000**0.5)


@pytest.mark.parametrize("relaxation", ["gumbel_softmax", "straight_through"])
def test_antithetic_pairs_have_the_mean_of_independent_draws(relaxation, generator):
    pose = only(bins=4, temperature=0.5, floor=0.01)
    psi = torch.tensor([0.5, -0.5, 1.0, 0.0], dtype=torch.float64)
    count = 20_000
    plain, paired = (
        _contributions(
            pose, psi, pose.draw_noise(count, generator, torch.float64, antithetic), relaxation, torch.cos
        )
        for antithetic in (False, True)
    )
    pairs = paired.unflatten(0, (-1, 2)).mean(1)
    error = (plain.var(0) / count + pairs.var(0) / len(pairs)).sqrt()
    assert ((plain.mean(0) - pairs.mean(0)).abs() < 4 * error).all()
    assert (plain.mean(0).abs() > 5 * error).any()


def test_gumbel_rao_wants_its_noise(generator):
    pose = only()
    with pytest.raises(ValueError, match="conditional"):
        pose.relaxed(torch.zeros(8), pose.draw_noise(2, generator), "gumbel_rao")


def test_further_noise_leaves_the_other_noise_as_it_was():
    plain, more = (only().draw_noise(4, torch.Generator().manual_seed(0), conditional=n) for n in (0, 3))
    assert torch.equal(plain.bins["pose"].gumbel, more.bins["pose"].gumbel)
    assert torch.equal(plain.uniform["distance"], more.uniform["distance"])
    assert plain.bins["pose"].exponential is None and more.bins["pose"].exponential.shape == (4, 3, 8)


def test_log_prob_sums_to_one_over_bins():
    pose = only()
    psi = torch.linspace(-2, 2, 8, dtype=torch.float64)
    assert pose.log_prob(psi, drawn(torch.arange(8)[:, None])).exp().sum().item() == pytest.approx(1.0)


def test_biased_objects_have_their_own_distributions():
    (pose,) = Pose(biased={"pitcher": {"initial": {"dominant": 7}, "target": {"dominant": 3}}}).factors
    assert pose.probabilities("initial", "pitcher").argmax() == 6
    assert pose.probabilities("target", "pitcher").argmax() == 2
    assert pose.probabilities("target", "can").max().item() == pytest.approx(1 / 8)


def test_azimuth_bins_the_other_angle(generator):
    pose = only(axis="azimuth")
    draw = pose.hard(torch.zeros(8), pose.draw_noise(500, generator))
    assert torch.equal(pose.bins_of(draw), draw.bins)
    assert draw.phi.min() >= math.pi / 4 and draw.phi.max() <= 3 * math.pi / 4


@pytest.mark.parametrize(
    "bad", [{"bins": 0}, {"axis": "roll"}, {"bin_mean": "mode"}, {"temperature": 0.0}, {"floor": 0.2},
            {"other_range_deg": (10.0, -10.0)}]
)  # fmt: skip
def test_bad_settings_name_their_key(bad):
    with pytest.raises(ValueError, match=f"parameter.pose.{next(iter(bad))}"):
        Pose(**bad)
