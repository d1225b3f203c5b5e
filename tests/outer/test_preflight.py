"""First-order gains of a loss linear in p, where first order is exact; photographs that train from the start."""

import dataclasses
import math

import pytest
import torch
from small_loop import CHECKED, MICRO, small_loop

from neural_sim.detector.real import Real
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.outer.inner import InnerLoop, LoopInputs, Numbers
from neural_sim.outer.objective import Loss
from neural_sim.outer.preflight import PhotographGain, equivalent, gains_of, photograph_gains
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.parameter.bins import closing
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution

NAMES = ("a", "b")
COST = torch.tensor([[0.3, 0.1, 0.5, 0.2], [0.2, 0.2, 0.2, 0.2]], dtype=torch.float64)


class Result:
    """A derivative with respect to logits with the same standard error everywhere."""

    def __init__(self, gradient, error):
        self.gradients = dict(zip(NAMES, gradient, strict=True))
        self.errors = {name: torch.full_like(gradient[0], error) for name in NAMES}


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
    region = TrustRegion(radius=radius, largest=1.0, keep=keep)
    return gains_of(results, distribution, psi, NAMES, moved, region)


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


def test_no_gain_is_told_of_a_bin_to_which_nothing_can_move(distribution, psi):
    """The closed bin has the lowest cost of all; the gains of the others are those without it."""
    psi = closing(psi, torch.tensor([[False, True, False, False], [False] * 4]))
    first, second = gains(distribution, psi, 0.0)
    assert first.by_bin[1] is first.by_bin_error[1] is None and None not in second.by_bin
    p = psi.softmax(-1)[0]
    for bin in (0, 2, 3):
        after = 0.8 * p + 0.2 * torch.eye(4, dtype=torch.float64)[bin]
        assert first.by_bin[bin] == pytest.approx(float((p - after) @ COST[0]), abs=1e-12)


@pytest.mark.parametrize("trainings", [2, 3])
def test_every_trial_has_probes_of_its_own_as_far_as_they_are_renewed(loop, trainings):
    """Half of the probes are renewed before each derivative after the first, by turns, whether or not psi moves."""
    drawn = []
    for _ in range(1 + trainings):
        loop.derivative()
        drawn.append(loop._probes.cached.features[0].flatten(1))
    same = [(drawn[0] == later).all(1).view(-1, 2).tolist() for later in drawn[1:]]
    assert same[0] == [[False, True]] * 8 and same[1] == [[False, False]] * 8


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


@pytest.fixture
def loop(scene):
    estimator = StratifiedEstimator(probes_per_bin=2)
    adjoint = {"adjoint": Implicit(), "objective": Loss()}
    return small_loop(scene, estimator, detector=MICRO, pool_per_bin=2, **CHECKED | adjoint)


@pytest.fixture
def photographs(scene):
    return scene.training_set(torch.zeros(2, 4), 4, torch.Generator().manual_seed(5)).images


def test_gains_are_those_of_trainings_with_and_without_the_photographs(loop, photographs):
    theta, psi = loop.theta, loop.psi.clone()
    first, second = photograph_gains(loop, photographs, (3, 50), trials=2, seed=7)
    assert (first.photographs, second.photographs) == (3, 8)  # there are eight
    assert loop.theta is theta and torch.equal(loop.psi, psi)
    falls = []
    for numbers in range(2):
        losses = []
        for count in (0, 3):
            real = Real("combined", count=count)
            inputs = LoopInputs(
                loop.inner.detector,
                theta,
                loop.inner.objective.images,
                real.chosen(photographs, 7) if count else None,
            )
            training = Training(batch_size=4, weight_decay=0.0, real=real)
            generator = torch.Generator().manual_seed(loop.numbers.generator.initial_seed())
            inner = InnerLoop.prepare(
                loop.scene, inputs, loop.settings, training, generator, loop.inner.draws
            )
            # Pool and initial parameters come from a generator that has gone on, so they are those of the loop.
            inner = dataclasses.replace(inner, pool=loop.inner.pool, start=loop.inner.start)
            losses.append(inner.train(psi, Numbers(generator, True, numbers)).validation_loss)
        falls.append(losses[0] - losses[1])
    assert first.fall == pytest.approx(sum(falls) / 2, abs=1e-6)
    assert first.error == pytest.approx(abs(falls[0] - falls[1]) / 2, abs=1e-6)
    assert first.fall != second.fall != 0.0


def test_numbers_in_between_are_interpolated():
    gains = [PhotographGain(25, 0.4, None), PhotographGain(10, 0.1, None)]
    assert equivalent(gains, 0.05) == pytest.approx(5.0)
    assert equivalent(gains, 0.1) == pytest.approx(10.0)
    assert equivalent(gains, 0.25) == pytest.approx(17.5)
    assert equivalent(gains, 0.5) is None
    assert equivalent(gains, 0.0) == equivalent(gains, -0.1) == 0.0
    harmful = [PhotographGain(10, -0.1, None), PhotographGain(25, 0.1, None)]
    assert equivalent(harmful, 0.05) == pytest.approx(10.0 + 15.0 * 0.75)
    assert equivalent(harmful, -0.05) == 0.0
    useless = [PhotographGain(10, 0.0, None)]
    assert equivalent(useless, 0.0) == 0.0 and equivalent(useless, 0.05) is None


def test_bad_numbers_are_refused(loop, photographs):
    with pytest.raises(ValueError, match="counts of at least 1, got 1, "):
        photograph_gains(loop, photographs, (0,), 1, 0)
    with pytest.raises(ValueError, match="trials >= 1"):
        photograph_gains(loop, photographs, (1,), 0, 0)
