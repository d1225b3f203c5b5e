"""The response of training against trainings run by hand, and against scores that are linear in p."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from small_loop import CHECKED, small_loop

from neural_sim.baseline.base import Response as Method
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import Response, ResponseLoop, agreement, centred_cosine, response
from neural_sim.outer.steps import LearnedObjects
from neural_sim.parameter.bins import closing
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution

PSI = torch.tensor([[0.5, 0.0, -0.5, 0.0], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture
def loop(scene):
    return small_loop(scene, StratifiedEstimator(probes_per_bin=2), psi=PSI, pool_per_bin=2, **CHECKED)


@dataclasses.dataclass(frozen=True)
class Linear(InnerLoop):
    """An inner problem in which a training's scores are ``sum_b p_b s_b`` of each object, without a training."""

    bins: torch.Tensor | None = None

    def train(self, psi, numbers, theta=None, recording=None):
        trained = self.untrained(psi, numbers, self.params)
        p = self.scene.distribution.probabilities(psi)["pose"]
        found = (p * self.bins).sum(1, keepdim=True).expand(-1, 8) / 8

        class Scored(type(trained)):
            scores = found

        held = {field.name: getattr(trained, field.name) for field in dataclasses.fields(trained)}
        return Scored(**held)


def linear(inner, scores):
    held = {field.name: getattr(inner, field.name) for field in dataclasses.fields(inner)}
    return Linear(**held, bins=scores)


def test_it_is_what_trainings_run_by_hand_do(loop):
    inner, numbers = loop.inner, loop.numbers
    found = response(inner, PSI, numbers, part=0.5)
    assert found.trainings == 1 + 4

    def scored(p):
        return inner.train(inner.scene.distribution.factors[0].psi_of(p), numbers).scores.sum(1)

    assert numbers.common
    p = inner.scene.distribution.probabilities(PSI)["pose"]
    # In the second run the first object moves to bin 1 and the other to bin 1 + 3 = 0.
    there = torch.eye(4, dtype=torch.float64)[[1, 0]]
    rise = (scored(0.5 * p + 0.5 * there) - scored(p)).double()
    torch.testing.assert_close(found.value[[0, 1], [1, 0]], rise / 0.5, rtol=1e-6, atol=1e-6)


def test_it_has_common_numbers_whatever_the_loop_has_and_counts_what_it_spent(loop):
    numbers = dataclasses.replace(loop.numbers, common=False)
    found = response(loop.inner, PSI, numbers)
    assert not numbers.common and (found.cost.images, found.cost.detector_steps) == (5 * 12, 5 * 3)
    assert torch.equal(found.value, response(loop.inner, PSI, loop.numbers).value)


def test_of_scores_linear_in_p_it_is_the_derivative(loop):
    inner = loop.inner
    scores = torch.tensor([[0.1, 0.9, 0.2, 0.3], [0.5, 0.1, 0.4, 0.6]], dtype=torch.float64)
    found = response(linear(inner, scores), PSI, loop.numbers, part=0.15).slopes(inner, PSI)
    leaf = PSI.clone().requires_grad_()
    p = inner.scene.distribution.probabilities(leaf)["pose"]
    (wanted,) = torch.autograd.grad(-(p * scores).sum(1).mean(), leaf)
    # The floor under p, 0.005 of each bin, is all that they differ by.
    torch.testing.assert_close(found, wanted, rtol=0.05, atol=1e-4)


def test_agreement_is_one_with_the_derivative_itself_and_minus_one_against_it(loop):
    inner = loop.inner
    scores = torch.rand(2, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    slopes = response(linear(inner, scores), PSI, loop.numbers).slopes(inner, PSI)

    def told(times):
        return SimpleNamespace(gradients=dict(zip(inner.scene.names, times * slopes, strict=True)))

    second = LearnedObjects(["b"], [1], inner.scene.distribution)
    assert agreement(slopes, PSI, told(2.0), loop.objects) == pytest.approx(1.0)
    assert agreement(slopes, PSI, told(-1.0), second) == pytest.approx(-1.0)
    assert agreement(slopes, PSI, told(0.0), loop.objects) is None


def test_agreement_includes_objects_with_closed_bins(loop):
    """A bin that is never drawn has no part in it: a derivative agrees if it is right elsewhere, its opposite not."""
    inner, closed = loop.inner, torch.tensor([[False, True, False, False], [False] * 4])
    psi = closing(PSI, closed)
    scores = torch.rand(2, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    slopes = response(linear(inner, scores), psi, loop.numbers).slopes(inner, psi)
    first = LearnedObjects(["a"], [0], inner.scene.distribution)
    for sign in (1.0, -1.0):
        told = SimpleNamespace(gradients=dict(zip(inner.scene.names, sign * slopes, strict=True)))
        assert agreement(slopes, psi, told, first) == pytest.approx(sign)


@pytest.mark.parametrize("bins", [1, 2, 3, 4, 6])
def test_objects_move_to_every_bin_and_consecutive_ones_to_different_bins(scene, monkeypatch, bins):
    distribution, psi = SceneDistribution.of([Pose(bins=bins)]), torch.zeros(2, bins, dtype=torch.float64)
    scene = dataclasses.replace(scene, distribution=distribution)
    estimator, moved = StratifiedEstimator(probes_per_bin=2), []
    loop = small_loop(scene, estimator, psi=psi, pool_per_bin=2, **CHECKED)
    inner = linear(loop.inner, torch.zeros(2, bins, dtype=torch.float64))
    train = Linear.train
    monkeypatch.setattr(
        Linear, "train", lambda self, at, *more: (moved.append(at), train(self, at, *more))[1]
    )
    response(inner, psi, loop.numbers)
    places = torch.stack([distribution.probabilities(at)["pose"].argmax(1) for at in moved[1:]])
    assert all(sorted(own) == list(range(bins)) for own in places.T.tolist())
    assert bins == 1 or bool((places[:, 0] != places[:, 1]).all())


def test_its_loop_climbs_to_the_best_bins(scene):
    module = small_loop(scene, StratifiedEstimator(probes_per_bin=2), iterations=6, pool_per_bin=2, **CHECKED)
    inner = linear(module.inner, torch.eye(4, dtype=torch.float64)[[2, 1]])
    loop = ResponseLoop(inner, PSI, 0.15, module.numbers.generator)
    learned = learn_psi(loop)
    p = scene.distribution.probabilities(learned.last)["pose"]
    assert p.argmax(1).tolist() == [2, 1] and float(p.amax(1).min()) > 0.9
    assert all(
        v.accepted for record in learned.records for v in record.verdicts.values() if v.expected_gain > 1e-3
    )
    assert learned.records[0].certificate.adjoint is None


def test_the_loop_compares_its_derivative_with_it_every_so_often(scene):
    estimator = StratifiedEstimator(probes_per_bin=2)
    loop = small_loop(scene, estimator, iterations=3, pool_per_bin=2, certify_every=2, **CHECKED)
    assert isinstance(loop, SimulatorModule)
    records = learn_psi(loop).records
    assert records[0].certificate.cosine is None and -1.0 <= records[1].certificate.cosine <= 1.0


@pytest.mark.parametrize("part", [0.0, 1.5])
def test_a_part_out_of_range_is_refused(loop, part):
    with pytest.raises(ValueError, match="part"):
        response(loop.inner, PSI, loop.numbers, part=part)
    with pytest.raises(ValueError, match="part"):
        Method("response", part)


def test_slopes_share_out_over_all_classes(loop):
    value = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    slopes = Response(value, 5).slopes(loop.inner, PSI)
    assert float(slopes[0, 0]) < 0.0 and float(slopes[0].sum()) == pytest.approx(0.0, abs=1e-12)
    assert not slopes[1].any()


def test_cosines_are_blind_to_a_common_shift():
    left, right = torch.tensor([1.0, 2.0, 4.0]), torch.tensor([3.0, 4.0, 6.0])
    assert centred_cosine(left, right) == pytest.approx(1.0)
    assert math.isnan(centred_cosine(left, torch.ones(3)))
