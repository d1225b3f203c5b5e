"""The response of training against trainings run by hand, and against scores that are linear in p."""

import math
from types import SimpleNamespace

import pytest
import torch
from small_loop import small_loop

from neural_sim.baseline.base import Response as Method
from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import Response, ResponseLoop, agreement, centred_cosine, response

CHECKED = {"steps": "checked", "adjoint": "unrolled", "train_first": True, "objective": "average_precision"}
PSI = torch.tensor([[0.5, 0.0, -0.5, 0.0], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.fixture
def inner(scene):
    return small_loop(scene, StratifiedEstimator(probes_per_bin=2), psi=PSI, pool_per_bin=2, **CHECKED).inner


def linear(inner, scores):
    """Make a training's scores ``sum_b p_b s_b`` of each object, without a training."""
    last = {}

    def draw(psi):
        last["p"] = inner.scene.distribution.probabilities(psi)["pose"]
        return type(inner).draw(inner, psi)

    inner.draw = draw
    inner.train = lambda images, recording=None: 0.0
    inner.scores = lambda: (last["p"] * scores).sum(1, keepdim=True).expand(-1, 8) / 8
    return inner


def test_it_is_what_trainings_run_by_hand_do(inner):
    found = response(inner, PSI, part=0.5)
    assert found.trainings == 1 + 4

    def scored(p):
        psi = inner.scene.distribution.factors[0].psi_of(p)
        inner.train(CachedSet.of(inner.detector, inner.backbone, inner.draw(psi).images))
        return inner.scores().sum(1)

    inner.common_numbers = True
    p = inner.scene.distribution.probabilities(PSI)["pose"]
    # In the second run the first object moves to bin 1 and the other to bin 1 + 3 = 0.
    there = torch.eye(4, dtype=torch.float64)[[1, 0]]
    rise = (scored(0.5 * p + 0.5 * there) - scored(p)).double()
    torch.testing.assert_close(found.value[[0, 1], [1, 0]], rise / 0.5, rtol=1e-6, atol=1e-6)


def test_it_leaves_the_loop_as_it_was_and_counts_what_it_spent(inner):
    theta, images, steps = inner.theta, inner.images, inner.steps
    inner.common_numbers = False
    response(inner, PSI)
    assert inner.theta is theta and not inner.common_numbers
    assert inner.images - images == 5 * 12 and inner.steps - steps == 5 * 3


def test_of_scores_linear_in_p_it_is_the_derivative(inner):
    scores = torch.tensor([[0.1, 0.9, 0.2, 0.3], [0.5, 0.1, 0.4, 0.6]], dtype=torch.float64)
    found = response(linear(inner, scores), PSI, part=0.15).slopes(inner, PSI)
    leaf = PSI.clone().requires_grad_()
    p = inner.scene.distribution.probabilities(leaf)["pose"]
    (wanted,) = torch.autograd.grad(-(p * scores).sum(1).mean(), leaf)
    # The floor under p, 0.005 of each bin, is all that they differ by.
    torch.testing.assert_close(found, wanted, rtol=0.05, atol=1e-4)


def test_agreement_is_one_with_the_derivative_itself_and_minus_one_against_it(inner):
    scores = torch.rand(2, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    slopes = response(linear(inner, scores), PSI).slopes(inner, PSI)

    def told(times):
        return SimpleNamespace(psi_gradients=dict(zip(inner.scene.names, times * slopes, strict=True)))

    assert agreement(inner, PSI, told(2.0), [0, 1]) == pytest.approx(1.0)
    assert agreement(inner, PSI, told(-1.0), [1]) == pytest.approx(-1.0)
    assert math.isnan(agreement(inner, PSI, told(0.0), [0, 1]))


def test_its_loop_climbs_to_the_best_bins(scene):
    module = small_loop(scene, StratifiedEstimator(probes_per_bin=2), iterations=6, pool_per_bin=2, **CHECKED)
    loop = ResponseLoop(linear(module.inner, torch.eye(4, dtype=torch.float64)[[2, 1]]), PSI, 0.15)
    learned = learn_psi(loop, progress=False)
    p = scene.distribution.probabilities(learned.last)["pose"]
    assert p.argmax(1).tolist() == [2, 1] and float(p.amax(1).min()) > 0.9
    assert all(
        v.accepted for record in learned.records for v in record.verdicts.values() if v.expected_gain > 1e-3
    )
    assert learned.records[0].certificate.solver_status == "MEASURED"


def test_the_loop_compares_its_derivative_with_it_every_so_often(scene):
    estimator = StratifiedEstimator(probes_per_bin=2)
    loop = small_loop(scene, estimator, iterations=3, pool_per_bin=2, certify_every=2, **CHECKED)
    assert isinstance(loop, SimulatorModule)
    records = learn_psi(loop, progress=False).records
    assert math.isnan(records[0].certificate.cosine) and -1.0 <= records[1].certificate.cosine <= 1.0


@pytest.mark.parametrize("part", [0.0, 1.5])
def test_a_part_out_of_range_is_refused(inner, part):
    with pytest.raises(ValueError, match="part"):
        response(inner, PSI, part)
    with pytest.raises(ValueError, match="part"):
        Method("response", part)


def test_slopes_share_out_over_all_classes(inner):
    value = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    slopes = Response(value, 5).slopes(inner, PSI)
    assert float(slopes[0, 0]) < 0.0 and float(slopes[0].sum()) == pytest.approx(0.0, abs=1e-12)
    assert not slopes[1].any()


def test_cosines_are_blind_to_a_common_shift():
    left, right = torch.tensor([1.0, 2.0, 4.0]), torch.tensor([3.0, 4.0, 6.0])
    assert centred_cosine(left, right) == pytest.approx(1.0)
    assert math.isnan(centred_cosine(left, torch.ones(3)))
