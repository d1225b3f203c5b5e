"""Trust-region steps: where they go, what evidence moves them, and what a training's outcome does to them."""

import math
from dataclasses import replace
from statistics import NormalDist

import pytest
import torch

from neural_sim.gradient.hypergradient import Hypergradient, UnrolledAdjoint
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.certificate import Trust, certify
from neural_sim.outer.steps import FreeSteps, LearnedObjects, slopes_by_p
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.parameter.bins import closing
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import SGD

POSE = BinnedFactor("pose", "phi", 4, 0.0, 2 * math.pi)
NAMES = ("a", "b")


def hypergradient(gradient, error, names=NAMES):
    both = (dict(zip(names, values, strict=True)) for values in (gradient, error))
    return Hypergradient(*both, UnrolledAdjoint(1, True, 0.0))


def steps_at(psi, factors=(POSE,), labels=(0, 1), **checks):
    checks = {"radius": 0.5, "largest": 0.7} | checks
    return TrustRegion(**checks).begin(LearnedObjects(NAMES, labels, SceneDistribution(factors)), psi, 10)


def scored(*values, images=8):
    """Scores to which all images add alike, so that their paired differences have no error."""
    return torch.tensor(values, dtype=torch.float64)[:, None].expand(-1, images) / images


def proposed(steps, gradient, error, level=0.05):
    """The steps after the next one, by that derivative, and its p-values."""
    result = hypergradient(gradient, error)
    steps, p_values = steps.observe(result)
    factors = steps.objects.distribution.names
    certificate = certify(result, p_values, NAMES, factors, Trust(level), Unrolled())
    return steps.propose(certificate, 0.25), p_values


def gradients(target, psi):
    """Derivative of minus the mean score by logits, in closed form, for bins that score 1 at ``target``."""
    above = POSE.p_of(psi) - POSE.floor
    scores = torch.zeros_like(above)
    scores[range(len(above)), target] = 1.0
    return -above * (scores - (above * scores).sum(-1, keepdim=True) / above.sum(-1, keepdim=True))


def test_free_steps_shorten_evenly_down_to_the_final_one():
    """Five gradients that are the same, without momentum: each step has its length from its place alone."""
    psi, settings = torch.zeros(2, 4, dtype=torch.float64), FreeSteps(SGD(0.1, momentum=0.0), final_step=0.2)
    steps = settings.begin(LearnedObjects(NAMES, (0, 1), SceneDistribution((POSE,))), psi, iterations=5)
    gradient = gradients([1, 2], psi)
    result, lengths = hypergradient(gradient, torch.zeros_like(gradient)), []
    for _ in range(5):
        before, (steps, p_values) = steps.reported, steps.observe(result)
        certificate = certify(result, p_values, NAMES, ("pose",), Trust(None), Unrolled())
        steps = steps.propose(certificate, 1.0)
        lengths.append(float((steps.reported - before).norm() / (0.1 * gradient.norm())))
    assert lengths == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2])


def variation(factor, a, b):
    return 0.5 * (factor.p_of(a) - factor.p_of(b)).abs().sum(-1)


def test_steps_go_where_the_score_is_by_the_radius_and_promise_their_first_order_gain():
    psi = POSE.psi_of(torch.tensor([[0.7, 0.1, 0.1, 0.1], [0.25, 0.25, 0.25, 0.25]], dtype=torch.float64))
    steps = steps_at(psi, radius=0.2)
    gradient = gradients([2, 3], psi)
    steps, p_values = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    p, before = POSE.p_of(tried), POSE.p_of(psi)
    assert p.argmax(1)[1] == 3 and float((p - before)[0, 2]) > 0.15
    torch.testing.assert_close(
        variation(POSE, tried, psi), torch.full((2,), 0.2, dtype=torch.float64), atol=1e-6, rtol=0
    )
    assert max(p_values["a"]["pose"], p_values["b"]["pose"]) < 1e-6
    steps, verdicts = steps.judge(scored(0.0, 0.0), scored(0.1, 0.1))
    # The score is linear in p: the promise is its change.
    for i, name in enumerate(NAMES):
        assert verdicts[name].expected_gain == pytest.approx(float((p - before)[i, [2, 3][i]]), rel=1e-9)


@pytest.mark.parametrize("keep", [0.5, 0.9])
def test_a_step_leaves_each_bin_the_fraction_that_the_settings_say(keep):
    psi = torch.zeros(2, 4, dtype=torch.float64)
    gradient = gradients([1, 2], psi)
    steps, _ = proposed(steps_at(psi, keep=keep), gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    assert POSE.p_of(tried).amin(1).tolist() == pytest.approx([0.25 * keep] * 2)


def test_directions_are_derivatives_by_p_where_a_bin_is_at_the_floor():
    """Logits' derivatives are p - floor times those of p: divided by p, that of a bin at the floor would be near 0."""
    floored = BinnedFactor("pose", "phi", 4, 0.0, 2 * math.pi, floor=0.005)
    psi = torch.tensor([[4.0, 0.0, 0.0, -8.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    scores = torch.tensor([[0.0, 0.0, 0.5, 1.0], [0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
    (by_logits,) = torch.autograd.grad((floored.log_probabilities(psi).exp() * scores).sum(), psi)
    steps = steps_at(psi.detach(), factors=(floored,))
    steps, _ = steps.observe(hypergradient(-by_logits, torch.zeros_like(by_logits)))
    direction = steps.observed["pose"].value
    torch.testing.assert_close(direction, scores - scores.mean(1, keepdim=True))


def test_closed_bins_have_no_part_in_the_direction():
    """Scores of the open bins alone count; the direction is centred over them."""
    closed = torch.tensor([[False, True, False, False], [False] * 4])
    psi = closing(torch.tensor([[0.5, 0.0, -0.5, 0.2], [0.0] * 4], dtype=torch.float64), closed)
    scores = torch.tensor([[0.1, 9.0, 0.4, 0.7], [0.2, 0.3, 0.1, 0.5]], dtype=torch.float64)
    leaf = psi.clone().requires_grad_()
    (by_logits,) = torch.autograd.grad((POSE.p_of(leaf) * scores).sum(), leaf)
    direction, variance = slopes_by_p(POSE, psi, -by_logits, torch.where(closed, 0.0, 0.1).double())
    mean = scores.where(~closed, 0.0).sum(1, keepdim=True) / (~closed).sum(1, keepdim=True)
    torch.testing.assert_close(direction, (scores - mean).where(~closed, 0.0))
    assert torch.equal(variance > 0.0, ~closed)


def test_only_the_object_that_did_not_gain_goes_back_and_its_next_step_is_shorter():
    psi = torch.zeros(2, 4, dtype=torch.float64)
    steps = steps_at(psi)
    gradient = gradients([1, 2], psi)
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    steps, verdicts = steps.judge(scored(0.5, 0.5, 0.5), scored(0.6, 0.45, 0.5))
    assert verdicts["a"].accepted and not verdicts["b"].accepted
    assert verdicts["b"].measured_gain == pytest.approx(-0.05)
    assert torch.equal(steps.reported, torch.stack([tried[0], psi[1]]))
    assert steps.radius["pose"].tolist() == pytest.approx([0.65, 0.2])
    # The next step of b sets out from where it was.
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    again = steps.trial
    assert float(variation(POSE, again, psi)[1]) == pytest.approx(0.2, abs=1e-6)
    _, verdicts = steps.judge(scored(0.6, 0.5, 0.5), scored(0.7, 0.52, 0.5))
    assert verdicts["b"].measured_gain == pytest.approx(0.02)


def test_a_verdict_changes_the_radius_of_the_factors_that_moved_alone():
    zoom = BinnedFactor("zoom", "distance", 4, 1.0, 2.0)
    psi = torch.zeros(2, 8, dtype=torch.float64)
    steps = steps_at(psi, (POSE, zoom))
    gradient = torch.cat([gradients([1, 2], psi[:, :4]), torch.zeros(2, 4, dtype=torch.float64)], 1)
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    assert bool((tried[:, :4] != 0.0).any(1).all()) and not bool(tried[:, 4:].any())
    steps, _ = steps.judge(scored(0.5, 0.5, 0.5), scored(0.6, 0.4, 0.5))
    assert steps.radius["pose"].tolist() == pytest.approx([0.65, 0.2])
    assert steps.radius["zoom"].tolist() == [0.5, 0.5]


@pytest.mark.parametrize(("part", "moving"), [(0.0, 1), (0.8, 2)])
def test_the_most_significant_factor_counts_as_one_of_those_that_move(part, moving):
    """Bonferroni: its p-value times their number, of two factors of which the second moves or does not."""
    zoom, psi = BinnedFactor("zoom", "distance", 4, 1.0, 2.0), torch.zeros(2, 8, dtype=torch.float64)
    gradient = torch.cat([gradients([1, 2], psi[:, :4]), part * gradients([2, 1], psi[:, :4])], 1)
    steps, p_values = proposed(
        steps_at(psi, (POSE, zoom)), gradient, torch.full_like(gradient, 0.1), level=0.9
    )
    assert [int(moved.sum()) for moved in steps.moved.values()] == [2, 2 * (moving - 1)]
    expected = [-NormalDist().inv_cdf(moving * min(p_values[name].values())) for name in NAMES]
    assert steps.significance.tolist() == pytest.approx(expected, rel=1e-9)


def scattering(images=50):
    """Scores of one class whose sum is 0 and has a standard error of 1."""
    noise = torch.randn(images, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (noise - noise.mean()) / noise.std() / images**0.5


@pytest.mark.parametrize(
    ("change", "accepted", "radius"),
    [(-1.1, False, 0.2), (-0.9, True, 0.5), (0.9, True, 0.5), (1.1, True, 0.65)],
)
def test_a_radius_grows_after_a_rise_and_shrinks_after_a_fall_beyond_the_error(change, accepted, radius):
    """After so significant a derivative only a fall beyond the error rejects a step."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64))
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    steps, verdicts = steps.judge(torch.zeros(2, 50), scattering() + torch.tensor([[change], [3.0]]) / 50)
    assert [verdict.accepted for verdict in verdicts.values()] == [accepted, True]
    assert steps.radius["pose"].tolist() == pytest.approx([radius, 0.65])


@pytest.mark.parametrize("noise", [0.05, 0.1, 0.15])
@pytest.mark.parametrize(("beyond", "accepted"), [(-0.05, False), (0.05, True)])
def test_the_derivative_and_the_measured_gain_are_significant_together(noise, beyond, accepted):
    """Stouffer's sum of the two quantiles, from the standard library's normal distribution."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64), level=0.05)
    steps, p_values = proposed(steps, gradient, torch.full_like(gradient, noise), level=0.9)
    normal = NormalDist()
    least = -(2.0**0.5) * normal.inv_cdf(0.05) + normal.inv_cdf(p_values["a"]["pose"])
    steps, verdicts = steps.judge(torch.zeros(2, 50), (scattering() + (least + beyond) / 50).expand(2, -1))
    verdict = verdicts["a"]
    assert verdict.accepted == accepted
    assert verdict.error == pytest.approx(1.0) and verdict.measured_gain == pytest.approx(least + beyond)
    assert accepted or steps.radius["pose"].tolist() == pytest.approx(
        [0.5 * (0.4**0.5 if least + beyond > -1.0 else 0.4)] * 2
    )


def test_what_objects_at_rest_gain_or_lose_is_the_error_of_trainings():
    """The first object moves; the other, without a significant derivative, loses 0.3 where its images explain 0.05."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    error = torch.stack([torch.full((4,), 0.1), torch.full((4,), torch.inf)]).double()
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64))
    steps, _ = proposed(steps, gradient, error, level=0.9)
    after = torch.stack([0.1 * scattering() + 0.5 / 50, 0.05 * scattering() - 0.3 / 50])
    _, verdicts = steps.judge(torch.zeros(2, 50), after)
    assert verdicts["a"].error == pytest.approx(math.hypot(0.1, math.sqrt(0.3**2 - 0.05**2)))


def test_one_judgment_after_which_objects_at_rest_gain_much_does_not_count_as_scatter():
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    error = torch.stack([torch.full((4,), 1e-4), torch.full((4,), torch.inf)]).double()
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64), radius=0.1, grow=1.0)
    for others, scatter in ((0.3, 0.3), (0.02, math.sqrt((0.3**2 + 0.02**2) / 2)), (0.04, 0.04)):
        steps, _ = proposed(steps, gradient, error, level=0.9)
        steps, verdicts = steps.judge(scored(0.0, 0.0), scored(0.5, others))
        assert verdicts["a"].error == pytest.approx(scatter)


def test_steps_that_gain_for_themselves_and_cost_others_more_are_all_rejected():
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64))
    gradient = gradients([1, 2], steps.accepted)
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    steps, verdicts = steps.judge(scored(0.5, 0.5, 0.5), scored(0.52, 0.51, 0.3))
    assert not any(verdict.accepted for verdict in verdicts.values())
    assert float(steps.reported.abs().max()) == 0.0
    assert steps.radius["pose"].tolist() == pytest.approx([0.2, 0.2])


def test_what_others_lose_counts_beyond_the_error_of_the_sum():
    """An object gains 0.1; the other class loses 0.2, by scores that scatter more or less than that."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    scatter = torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scatter = (scatter - scatter.mean()) / scatter.std() / 50**0.5
    for error, kept in ((0.05, False), (0.2, True)):
        steps = steps_at(torch.zeros(2, 4, dtype=torch.float64))
        steps, _ = proposed(
            steps, gradient, torch.stack([torch.full((4,), 1e-4), torch.full((4,), torch.inf)])
        )
        others = error * scatter - 0.2 / 50
        steps, verdicts = steps.judge(
            torch.zeros(2, 50), torch.stack([torch.full_like(others, 0.1 / 50), others])
        )
        assert verdicts["a"].accepted == kept


@pytest.mark.parametrize(("fall", "kept"), [(0.4, True), (0.6, False)])
def test_what_classes_win_and_lose_in_the_same_images_is_no_error_of_the_sum(fall, kept):
    """Two classes change by turns, so that their sum, a gain of 0.5, has no error; another class falls."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    steps, _ = proposed(
        steps_at(torch.zeros(2, 4, dtype=torch.float64)), gradient, torch.full_like(gradient, 1e-4)
    )
    turns = 0.3 * scattering()
    after = torch.stack([turns + 0.2 / 50, 0.3 / 50 - turns, torch.full_like(turns, -fall / 50)])
    _, verdicts = steps.judge(torch.zeros(3, 50), after)
    assert [verdict.accepted for verdict in verdicts.values()] == [kept, kept]


@pytest.mark.parametrize(("fall", "kept"), [(0.17, True), (0.18, False)])
def test_trainings_scatter_in_every_class_adds_to_the_error_of_the_sum(fall, kept):
    """Between trainings each of the three classes scatters by 0.1, and their sum by 0.1 sqrt(3) = 0.173."""
    gradient = gradients([1, 2], torch.zeros(2, 4, dtype=torch.float64))
    steps = replace(steps_at(torch.zeros(2, 4, dtype=torch.float64)), at_rest=(0.01,))
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    # A class without a box has no score, and adds no error either.
    _, verdicts = steps.judge(scored(0.0, 0.0, 0.0, math.nan), scored(0.5, 0.5, -1.0 - fall, math.nan))
    assert [verdict.accepted for verdict in verdicts.values()] == [kept, kept]


def test_without_evidence_nothing_moves_and_consistent_evidence_adds_up():
    psi = torch.zeros(2, 4, dtype=torch.float64)
    steps = steps_at(psi, momentum=1.0)
    gradient = gradients([1, 2], psi) * 0.3
    noise = torch.full_like(gradient, 0.03)
    found = []
    for _ in range(6):
        steps, p_values = proposed(steps, gradient, noise, level=0.01)
        tried = steps.trial
        found.append(p_values["a"]["pose"])
        assert steps.pending == (not torch.equal(tried, psi))
    assert found[0] > 0.01 > found[-1]
    assert not torch.equal(tried, psi)


def test_an_object_whose_radius_is_too_small_rests():
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64), smallest=0.3)
    gradient = gradients([1, 2], steps.accepted)
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    steps, _ = steps.judge(scored(0.0, 0.0), scored(-1.0, -1.0))
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    assert torch.equal(tried, steps.accepted)


@pytest.mark.parametrize(("part", "moves"), [(0.1, False), (0.3, True)])
def test_an_object_of_little_gain_waits_until_the_large_steps_are_done(part, moves):
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64), waits_below=0.2)
    gradient = gradients([1, 2], steps.accepted) * torch.tensor([[1.0], [part]], dtype=torch.float64)
    small = torch.full_like(gradient, 1e-6)
    steps, p_values = proposed(steps, gradient, small)
    tried = steps.trial
    assert p_values["b"]["pose"] < 1e-6
    assert not torch.equal(tried[0], steps.accepted[0])
    assert torch.equal(tried[1], steps.accepted[1]) != moves
    waiting = steps.waiting
    steps, verdicts = steps.judge(scored(0.0, 0.0), scored(0.1, 0.1))
    assert ("b" in verdicts) == moves
    assert (("b", "pose") in waiting) != moves
    # Now that the derivative of the first is zero, that of the second counts.
    steps, _ = proposed(steps, gradient * torch.tensor([[-1.0], [1.0]], dtype=torch.float64), small)
    after = steps.trial
    assert not torch.equal(after[1], tried[1])


def test_a_derivative_that_is_not_finite_moves_nothing_and_is_forgotten():
    steps = steps_at(torch.zeros(2, 4, dtype=torch.float64))
    bad = torch.full((2, 4), math.nan, dtype=torch.float64)
    steps, _ = proposed(steps, bad, bad)
    tried = steps.trial
    assert torch.equal(tried, steps.accepted)
    gradient = gradients([1, 2], steps.accepted)
    steps, _ = proposed(steps, gradient, torch.full_like(gradient, 1e-4))
    tried = steps.trial
    assert POSE.p_of(tried).argmax(1).tolist() == [1, 2]


@pytest.mark.parametrize(
    "bad",
    [
        {"radius": 0.8},
        {"smallest": 0.0},
        {"keep": 1.0},
        {"grow": 0.9},
        {"trainings": 0},
        {"folds": 0},
        {"shrink": 1.0},
        {"momentum": -0.1},
        {"waits_below": 1.1},
        {"level": 0.0},
    ],
)
def test_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=r"TrustRegion|outer\.steps\.radius"):
        TrustRegion(**bad)
