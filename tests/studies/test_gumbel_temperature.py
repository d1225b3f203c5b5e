"""Bias and variance of estimates held against a truth, and where relaxed draws lie."""

import math
from dataclasses import replace

import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.studies.frozen_loop import FrozenLoop, State
from neural_sim.studies.gumbel_temperature import Temperatures, against, bin_frequencies


def test_bias_and_spread_of_known_estimates(generator):
    """Estimates of variance 4 about the truth plus 3 in every component, which is itself known to 0.1."""
    truth, errors = torch.tensor([5.0, -2.0, 1.0, 0.5]), torch.full((4,), 0.1)
    noise = torch.randn(4000, 4, generator=generator)
    bias, error, spread, cosine = against(truth + 3.0 + 2.0 * noise, truth, errors)
    assert bias == pytest.approx(6.0, abs=5.0 * error) and 0.1 < error < 0.12
    assert spread == pytest.approx(4.0, rel=0.05)
    assert cosine == pytest.approx(float(torch.cosine_similarity(truth + 3.0, truth, 0)), abs=0.02)


def test_noise_alone_is_no_bias(generator):
    """The root of a difference that is zero on average: below two of its standard errors nearly always."""
    found = [
        against(torch.randn(8, 6, generator=generator), torch.zeros(6), torch.zeros(6)) for _ in range(200)
    ]
    assert sum(bias == 0.0 for bias, *_ in found) > 60
    assert sum(bias > 2.0 * math.sqrt(6.0 / 8.0) for bias, *_ in found) < 5


@pytest.mark.parametrize(("temperature", "expected"), [(1e-3, None), (1e3, [0.0, 0.0, 1.0, 0.0, 0.0])])
def test_draws_follow_p_at_low_temperatures_and_meet_in_the_middle_at_high_ones(temperature, expected):
    factor = BinnedFactor("pose", "phi", 5, 0.0, 5.0, temperature=temperature)
    p = torch.tensor([0.1, 0.5, 0.05, 0.05, 0.3], dtype=torch.float64)
    shares = torch.tensor(bin_frequencies(factor, factor.psi_of(p), 20_000, 0), dtype=torch.float64)
    wanted = p if expected is None else torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(shares, wanted, rtol=0.0, atol=0.02)


@pytest.fixture(scope="module")
def loop(scene):
    psi = torch.tensor([[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    theta, validation = detector.init(generator), scene.training_set(psi, 3, generator).images
    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=6), max_steps=6)
    images = scene.training_set(psi, 4, generator).images
    return FrozenLoop.at(State(scene, detector, theta, psi), images, validation, solver, generator)


STUDY = Temperatures((1e-4,), rounds=2, truth_per_bin=4, draws=100)


def test_a_derivative_of_zero_is_refused_in_words(loop):
    """If a solve found no v, there is nothing for an error to be relative to."""
    still = replace(loop, vector={name: torch.zeros_like(value) for name, value in loop.vector.items()})
    with pytest.raises(ValueError, match=r"temperatures: the derivative of a, b is 0.*adjoint solve: "):
        STUDY.measure(still, PathwiseEstimator(), 4, seed=0)


def test_estimates_without_derivative_are_biased_by_the_whole_truth(loop):
    """At a temperature of 1e-4 no draw is near a tie: all of the truth is missed."""
    rows, truths = STUDY.measure(loop, PathwiseEstimator(), 4, seed=0)
    for row, truth in zip(rows, truths, strict=True):
        assert row.object == truth.object and row.spread < 1e-3 * truth.length
        expected = math.sqrt(max(0.0, truth.length**2 - truth.noise**2))
        assert row.bias == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"values": ()}, r"Temperatures\.values: want 1 or more values, got \[\]"),
        ({"values": (0.1, 0.0)}, r"Temperatures\.values\[1\]: want more than 0, got 0\.0"),
        ({"rounds": 1}, r"Temperatures\.rounds: want at least 2, got 1"),
        ({"draws": 0}, r"Temperatures\.draws: want at least 2, got 0"),
    ],
)
def test_bad_settings_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Temperatures(**wrong)
