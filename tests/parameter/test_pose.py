"""Pose draws: the right bins, replay, and the derivative of the relaxed draw."""

import math

import pytest
import torch

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
    ("bad", "message"),
    [
        ({"floor": 0.2}, r"parameter\.pose\.floor: want less than 1/8 for 8 bins, got 0\.2"),
        ({"other_range_deg": (0.0, 400.0)}, r"Pose\.other_range_deg: want .*at most a circle"),
        ({"initial": {"dominant": 9}, "biased": {"mug": {}}}, r"parameter\.pose\.initial of mug"),
    ],
)
def test_bad_settings_name_their_key(bad, message):
    with pytest.raises(ValueError, match=message):
        Pose(**bad)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"biased": {"mug": {"initail": "uniform"}}},
            r"biased\.mug\.initail: unknown key, want one of initial, target",
        ),
        (
            {"initial": {"dominant": 1, "peak": 2}},
            r"parameter\.pose\.initial: want uniform, .* got \{'dominant'",
        ),
        ({"target": "unifrm"}, r"parameter\.pose\.target: want uniform"),
    ],
)
def test_distributions_that_are_misspelt_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Pose(**settings)
