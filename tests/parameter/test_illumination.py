"""Weights of lights: specifications, steps that stay on the constraint, Gaussian draws and their score."""

import itertools
import math

import pytest
import torch

from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.update import SGD, Mirror, UpdateState

DOUBLE = torch.float64


def normal(generator, *shape):
    return torch.randn(shape, generator=generator, dtype=DOUBLE)


def test_specifications():
    biased = {"drill": {"initial": {"dominant": 2}}, "mug": {"target": [0.5, 0.25, 0.25]}}
    illumination = Illumination(anchors=3, target={"dominant": 1}, biased=biased)
    third = torch.full((3,), 1.0 / 3.0, dtype=DOUBLE)
    assert torch.equal(illumination.psi("initial", "can"), third)
    assert illumination.psi("initial", "drill").tolist() == pytest.approx([0.02, 0.96, 0.02])
    assert illumination.psi("target", "drill").tolist() == pytest.approx([0.96, 0.02, 0.02])
    assert illumination.psi("target", "mug").tolist() == [0.5, 0.25, 0.25]
    affine = Illumination(anchors=3, constraint="affine", initial=[1.5, -0.25, -0.25])
    assert affine.psi("initial", "can").tolist() == [1.5, -0.25, -0.25]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"anchors": 3, "initial": [1.5, -0.25, -0.25]}, "parameter.illumination.initial"),
        ({"anchors": 3, "constraint": "affine", "target": [1.0, 1.0, 0.0]}, "parameter.illumination.target"),
        ({"anchors": 3, "constraint": "affine", "target": [1.0, 0.0]}, "want 3 numbers"),
        ({"biased": {"mug": {"target": {"dominant": 9}}}}, "parameter.illumination.target of mug"),
    ],
)
def test_nonsense_is_refused(arguments, named):
    with pytest.raises(ValueError, match=named):
        Illumination(**arguments)


def test_every_image_of_an_object_has_psi(generator):
    psi = Illumination().psi("initial", "can").requires_grad_()
    drawn = Illumination().draw(psi, 5)
    assert torch.equal(drawn, psi.detach().expand(5, 6))
    cotangent = normal(generator, 5, 6)
    (gradient,) = torch.autograd.grad((drawn * cotangent).sum(), psi)
    torch.testing.assert_close(gradient, cotangent.sum(0))


def nearest_by_enumeration(point, constraint):
    """The nearest feasible point: the best projection on a face of the simplex among all faces."""
    k, best = len(point), None
    sizes = range(1, k + 1) if constraint == "simplex" else [k]
    for face in itertools.chain(*(itertools.combinations(range(k), size) for size in sizes)):
        candidate, on = torch.zeros_like(point), list(face)
        candidate[on] = point[on] - (point[on].sum() - 1.0) / len(on)
        if constraint == "simplex" and bool((candidate < 0).any()):
            continue
        if best is None or (candidate - point).norm() < (best - point).norm():
            best = candidate
    return best


def step(illumination, update, psi, gradient, standard_error, state):
    """A step of the psi loop: an update's in the Euclidean metric, then the projection."""
    moved, after = update.step(psi, illumination.log_slopes(psi), gradient, standard_error, state)
    return illumination.project(moved), after


@pytest.mark.parametrize("constraint", ["simplex", "affine"])
def test_a_step_is_a_gradient_step_and_its_projection(constraint, generator):
    """The first step has no momentum: by hand, -rate * centred gradient / its root mean square, bounded, projected."""
    illumination = Illumination(anchors=5, constraint=constraint)
    update = Mirror(learning_rate=0.4, max_step=0.5, shrink=False)
    for _ in range(20):
        psi = illumination.project(normal(generator, 3, 5))
        gradient = 100.0 * normal(generator, 3, 5)
        moved, _ = step(illumination, update, psi, gradient, torch.zeros_like(psi), UpdateState.zeros(psi))
        centred = gradient - gradient.mean(-1, keepdim=True)
        free = -0.4 * centred / centred.square().mean().sqrt()
        free = free * (0.5 / free.abs().amax(-1, keepdim=True)).clamp_max(1.0)
        for row, point in zip(moved, psi + free, strict=True):
            torch.testing.assert_close(row, nearest_by_enumeration(point, constraint), rtol=0, atol=1e-12)


@pytest.mark.parametrize("constraint", ["simplex", "affine"])
def test_steps_lead_to_the_constrained_optimum_of_a_quadratic(constraint, generator):
    """min |w - t|^2 / 2 over the constraint is the projection of t; both lie off the start and may touch a face."""
    illumination = Illumination(anchors=5, constraint=constraint)
    wanted = 0.7 * normal(generator, 2, 5)
    best = torch.stack([nearest_by_enumeration(row, constraint) for row in wanted])
    psi = torch.full((2, 5), 0.2, dtype=DOUBLE)
    state, update = UpdateState.zeros(psi), Mirror(learning_rate=0.2, momentum=0.3)
    for _ in range(400):
        psi, state = step(illumination, update, psi, psi - wanted, torch.zeros_like(psi), state)
    torch.testing.assert_close(psi, best, rtol=0, atol=1e-3)
    torch.testing.assert_close(psi.sum(-1), torch.ones(2, dtype=DOUBLE))


@pytest.mark.parametrize("constraint", ["simplex", "affine"])
def test_the_plain_step_is_momentum_and_projection_written_out(constraint, generator):
    illumination = Illumination(anchors=5, constraint=constraint)
    update = SGD(learning_rate=0.4, momentum=0.7)
    psi = illumination.project(normal(generator, 3, 5))
    state, gradients = UpdateState.zeros(psi), 10.0 * normal(generator, 6, 3, 5)
    for done in range(6):
        velocity = sum(0.7 ** (done - k) * gradients[k] for k in range(done + 1))
        free = psi - 0.4 * velocity
        psi, state = step(illumination, update, psi, gradients[done], torch.full_like(psi, 1e9), state)
        for row, point in zip(psi, free, strict=True):
            torch.testing.assert_close(row, nearest_by_enumeration(point, constraint), rtol=0, atol=1e-12)


def test_plain_steps_on_the_plane_follow_the_recursion_of_heavy_ball(generator):
    """On the affine plane the projection takes out the mean of a step and nothing else, so that momentum on
    |w - t|^2 / 2 is the heavy ball: e_{n+1} = (1 + m - r) e_n - m e_{n-1} for e = w - t within the plane."""
    illumination, rate, momentum = Illumination(anchors=5, constraint="affine"), 0.3, 0.9
    best = illumination.project(normal(generator, 2, 5))
    wanted = best + normal(generator, 2, 1)  # off the plane, along its normal
    psi = illumination.project(normal(generator, 2, 5))
    update, state, errors = SGD(rate, momentum), UpdateState.zeros(psi), [psi - best]
    for _ in range(40):
        psi, state = step(illumination, update, psi, psi - wanted, torch.zeros_like(psi), state)
        errors.append(psi - best)
        torch.testing.assert_close(psi.sum(-1), torch.ones(2, dtype=DOUBLE))
    torch.testing.assert_close(errors[1], (1.0 - rate) * errors[0], rtol=0, atol=1e-12)
    for before, now, after in zip(errors, errors[1:], errors[2:], strict=False):
        expected = (1.0 + momentum - rate) * now - momentum * before
        torch.testing.assert_close(after, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("update", [Mirror(), SGD(learning_rate=1.0)])
def test_a_gradient_that_is_not_finite_moves_nothing(update):
    illumination = Illumination(anchors=3)
    psi = torch.tensor([[0.2, 0.3, 0.5]], dtype=DOUBLE)
    broken = torch.tensor([[math.nan, 0.0, 1.0]], dtype=DOUBLE)
    moved, state = step(illumination, update, psi, broken, torch.zeros_like(psi), UpdateState.zeros(psi))
    torch.testing.assert_close(moved, psi)
    assert state.refused == 1 and state.steps == 0


def test_the_score_is_the_derivative_of_the_log_density(generator):
    illumination = Illumination(anchors=4, deviation=0.3)
    psi = illumination.project(normal(generator, 4)).requires_grad_()
    draw = illumination.explore(psi, torch.randn(6, len(psi), generator=generator, dtype=psi.dtype))
    assert not draw.unprojected.requires_grad
    density = torch.distributions.MultivariateNormal(psi, 0.09 * torch.eye(4, dtype=DOUBLE))
    torch.testing.assert_close(
        illumination.log_prob(psi, draw.unprojected), density.log_prob(draw.unprojected)
    )
    for i in range(6):
        one = draw.unprojected[i : i + 1]
        (score,) = torch.autograd.grad(illumination.log_prob(psi, one).sum(), psi)
        for j in range(4):
            step = torch.zeros(4, dtype=DOUBLE)
            step[j] = 1e-5
            with torch.no_grad():
                ahead, behind = (illumination.log_prob(psi + sign * step, one) for sign in (1, -1))
            assert float(score[j]) == pytest.approx(float(ahead - behind) / 2e-5, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("constraint", ["simplex", "affine"])
def test_draws_lie_on_the_constraint_around_psi(constraint, generator):
    illumination = Illumination(anchors=4, constraint=constraint, deviation=0.05)
    psi = torch.tensor([0.4, 0.3, 0.2, 0.1], dtype=DOUBLE)
    draw = illumination.explore(psi, torch.randn(4000, len(psi), generator=generator, dtype=psi.dtype))
    torch.testing.assert_close(draw.weights.sum(-1), torch.ones(4000, dtype=DOUBLE))
    if constraint == "simplex":
        assert draw.weights.min() >= 0.0
    spread = (draw.unprojected - psi).std(0)
    assert ((draw.unprojected.mean(0) - psi).abs() < 4 * 0.05 / math.sqrt(4000)).all()
    torch.testing.assert_close(spread, torch.full((4,), 0.05, dtype=DOUBLE), rtol=0.05, atol=0)


def test_the_score_estimates_the_gradient_of_the_expected_reward(generator):
    """E (f - f(psi)) score over unprojected draws against the gradient of E f, for f linear in the affine weights."""
    illumination = Illumination(anchors=3, constraint="affine", deviation=0.1)
    psi = torch.tensor([0.5, 0.3, 0.2], dtype=DOUBLE, requires_grad=True)
    slope = torch.tensor([1.0, -2.0, 0.5], dtype=DOUBLE)
    draw = illumination.explore(psi, torch.randn(40_000, len(psi), generator=generator, dtype=psi.dtype))
    reward = (draw.weights - psi.detach()) @ slope
    (estimate,) = torch.autograd.grad((reward * illumination.log_prob(psi, draw.unprojected)).mean(), psi)
    centred = slope - slope.mean()  # the projection on the plane takes the common part out
    # A component's variance over one draw is |c|^2 + c_i^2 for a linear reward of slope c.
    error = ((centred.square().sum() + centred.square()) / 40_000).sqrt()
    assert ((estimate - centred).abs() < 4 * error).all()
