"""The derivative of a training against central differences of the same training, and against autograd through it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from recorded_training import DOUBLE, EXACT, RATES, RULE, STEP, Micro, extrapolated

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.fcos import Fcos
from neural_sim.detector.settings import Backbone, Head
from neural_sim.detector.trajectory import AdamW, Recording, train
from neural_sim.gradient.reversal import Examples, RecordedTraining, reversed_steps
from neural_sim.gradient.unrolled import ProbeGroups, Unrolled
from neural_sim.solver.operator import flatten, unflatten


@pytest.fixture(scope="module")
def micro():
    return Micro()


@pytest.fixture(scope="module")
def pulled():
    return Micro(proximal=0.5)


def least_memory(problem):
    """Megabytes of six steps in two segments of three, without room for gradients."""
    theta = flatten(problem.like)
    return ((2 + 3) * len(RULE.begin(theta)) + 3) * 8 * theta.numel() / 2**20


@pytest.mark.parametrize("proximal", [False, True])
def test_the_derivative_by_image_weights_is_that_of_the_same_training(micro, pulled, proximal, generator):
    problem = pulled if proximal else micro
    direction = torch.randn(8, generator=generator, dtype=DOUBLE)
    found = float(problem.accumulated().images @ direction)

    def outcome(step):
        return problem.outer(problem.trained(problem.weighted(1.0 + step * direction)).end)

    assert found == pytest.approx(extrapolated(outcome, STEP), rel=1e-6)


def test_it_is_that_of_the_same_training_of_an_anchor_free_detector(generator):
    problem = Micro(detector=Fcos(3, 32, Backbone("micro"), Head(8, 1)))
    direction = torch.randn(8, generator=generator, dtype=DOUBLE)
    found = float(problem.accumulated().images @ direction)

    def outcome(step):
        return problem.outer(problem.trained(problem.weighted(1.0 + step * direction)).end)

    assert found == pytest.approx(extrapolated(outcome, STEP / 10), rel=1e-6)


def test_it_is_that_of_the_same_training_with_the_backbones_last_stage(generator):
    problem = Micro(layers=1)
    assert any(name.startswith("backbone.stages.3") for name in problem.like)
    direction = torch.randn(8, generator=generator, dtype=DOUBLE)
    found = float(problem.accumulated().images @ direction)

    def outcome(step):
        return problem.outer(problem.trained(problem.weighted(1.0 + step * direction)).end)

    # A convolution's gradients are smaller still: AdamW's steps bend within 1e-6, where rounding leaves five digits.
    assert found == pytest.approx(extrapolated(outcome, STEP / 100), rel=1e-5)


@pytest.mark.parametrize("wanted", ["weights", "inputs"])
def test_it_is_that_of_the_same_training_of_a_classifier(wanted, generator):
    """By the weights of images, and by their pooled features; the box says nothing and has no derivative."""
    problem = Micro(detector=Classifier(3, 32, Backbone("micro")))
    features, box = problem.cached.inputs
    weight = torch.randn(8, generator=generator, dtype=DOUBLE)
    move = torch.randn(features.shape, generator=generator, dtype=DOUBLE) * (wanted == "inputs")
    found = problem.accumulated(wanted=wanted)
    along = float(found.images @ weight)
    if wanted == "inputs":
        along += float((found.inputs[0] * move).sum())
        assert not found.inputs[1].any()

    def outcome(step):
        moved = Examples((features + step * move, box), problem.examples.losses)
        weights = 1.0 + step * weight
        examples = Examples(moved.inputs, lambda p, x, rows: weights[rows] * moved.losses(p, x, rows))
        return problem.outer(problem.trained(examples).end)

    assert along == pytest.approx(extrapolated(outcome, 10 * STEP), rel=1e-6)


def test_the_derivative_by_inputs_is_that_of_the_same_training(micro, generator):
    """Features of every level, and the boxes that anchors should predict."""
    directions = tuple(torch.randn(x.shape, generator=generator, dtype=DOUBLE) for x in micro.cached.inputs)
    found = micro.accumulated(wanted="inputs").inputs
    along = sum(float((x * d).sum()) for x, d in zip(found, directions, strict=True))
    assert all(bool(part.any()) for part in found)

    def outcome(step):
        moved = tuple(x + step * d for x, d in zip(micro.cached.inputs, directions, strict=True))
        return micro.outer(micro.trained(Examples(moved, micro.examples.losses)).end)

    assert along == pytest.approx(extrapolated(outcome, STEP), rel=1e-6)


def test_central_differences_stand_for_exact_products(pulled):
    """Six steps, each within the order eps^(2/3) = 4e-11 times third derivatives; 1e-7 leaves room for those."""
    exact, near = (
        pulled.accumulated(Unrolled(product=product), wanted="inputs")
        for product in ("reverse_over_reverse", "central_difference")
    )
    for ours, theirs in zip((near.images, *near.inputs), (exact.images, *exact.inputs), strict=True):
        assert float((ours - theirs).norm()) < 1e-7 * float(theirs.norm())


@pytest.mark.parametrize("kept", [True, False])
def test_forward_differences_stand_for_exact_products_of_probes_scores(pulled, kept):
    """Six steps, each within the order eps^(1/2) = 1.5e-8 times second derivatives, from gradients that were kept or
    computed again, the proximal term's taken out."""
    probes = ProbeGroups(pulled.cached.losses, [torch.arange(8).view(4, 2)])
    settings = {"probes_per_step": 0, "scored_steps": 0}
    recording = Recording() if kept else Recording(max_memory_mb=least_memory(pulled))
    exact, near = (
        pulled.accumulated(
            Unrolled(product=product, **settings), recording=recording, probes=probes, wanted="probes"
        )
        for product in ("reverse_over_reverse", "forward_difference")
    )
    assert float((near.probes - exact.probes).norm()) < 1e-5 * float(exact.probes.norm())
    assert not near.images.numel() and not near.inputs


def test_forward_differences_are_central_where_more_than_probes_is_wanted(pulled):
    """A second gradient is taken in any case, which serves the product as well."""
    one, other = (
        pulled.accumulated(Unrolled(product=product), wanted="weights")
        for product in ("forward_difference", "central_difference")
    )
    assert torch.equal(one.images, other.images)


def last_state(made):
    """The state that a recorded training ended in."""
    segment = made.segments()[0]
    state, gradient = made.replayed(segment, lambda *_: None)[-1]
    return made.rule.step(state, gradient, made.rates[-1], len(made) - 1)


def test_with_a_floor_it_is_the_derivative_of_a_training_with_that_floor(micro, generator):
    """A training whose denominators are at least those that a plain one ended with."""
    sizes = [part.numel() for part in micro.like.values()]
    rule = RULE.floored(last_state(micro.trained(micro.examples)), len(RATES), 1.0, sizes)
    direction = torch.randn(8, generator=generator, dtype=DOUBLE)
    found = float(micro.accumulated(rule=rule).images @ direction)

    def outcome(step):
        return micro.outer(micro.trained(micro.weighted(1.0 + step * direction), rule=rule).end)

    assert found == pytest.approx(extrapolated(outcome, STEP), rel=1e-6)


def test_with_a_floor_it_has_the_size_of_a_finite_change_where_the_first_gradient_is_tiny():
    """One number, of gradient 1e-9 in the first batch and 1 in the others, as of a part of a detector whose first
    object comes late. An image of gradient 1 enters the first batch with some weight: the first step is then one of
    the learning rate, whatever that weight."""
    slopes = torch.tensor([1e-9, 1.0, 1.0], dtype=DOUBLE)
    rows = tuple(torch.tensor(batch) for batch in ([0, 2], [1, 1], [1, 1], [1, 1]))
    like, rule = {"theta": torch.ones(1, dtype=DOUBLE)}, AdamW(0.0)

    def trained(weight, rule=rule):
        weights = torch.tensor([1.0, 1.0, weight], dtype=DOUBLE)
        examples = Examples((slopes,), lambda p, x, rows: weights[rows] * x[0] * p["theta"])
        gradient_at = lambda theta, rows: examples.gradient(theta, like, rows)  # noqa: E731
        return train(rule, flatten(like), rows, (0.1,) * 4, gradient_at)

    def derivative(floor):
        weighted = Examples((slopes,), lambda p, x, rows: x[0] * p["theta"])
        how, slope = Unrolled("reverse_over_reverse", floor=floor), torch.ones(1, dtype=DOUBLE)
        return float(
            how.accumulate(RecordedTraining(trained(0.0), weighted, like), slope, torch.Generator()).images[2]
        )

    finite = float(trained(0.15).end - trained(0.0).end) / 0.15
    assert 1 / 3 < derivative(0.3) / finite < 3.0
    # The loss is linear, so that a floor changes no gradient: it is the derivative of a training with that floor.
    floored = rule.floored(last_state(trained(0.0)), len(rows), 0.3, [1])
    smooth = extrapolated(lambda weight: float(trained(weight, floored).end), 1e-4)
    assert derivative(0.3) == pytest.approx(smooth, rel=1e-6)
    assert derivative(0.0) < 1e6 * finite < 0.0


def test_states_kept_and_states_computed_again_give_the_same(pulled):
    """Six steps in two segments of three; without room for gradients they are computed again."""
    least = least_memory(pulled)
    made = pulled.trained(pulled.examples, Recording(max_memory_mb=least))
    assert sorted(made.checkpoints) == [0, 3] and not made.gradients
    kept = pulled.accumulated()
    again = pulled.accumulated(recording=Recording(max_memory_mb=least))
    torch.testing.assert_close(again.images, kept.images, rtol=1e-12, atol=0.0)


def _small(generator, steps=5):
    """Weighted smooth regression of six rows by eight parameters, every step written out with its graph."""
    design, targets = (
        torch.randn(6, 4, generator=generator, dtype=DOUBLE),
        torch.randn(6, generator=generator, dtype=DOUBLE),
    )
    like = {
        "w": torch.randn(4, generator=generator, dtype=DOUBLE),
        "u": torch.randn(4, generator=generator, dtype=DOUBLE),
    }
    rows = tuple(torch.randperm(6, generator=generator)[:3] for _ in range(steps))

    def losses(params, inputs, index):
        return (
            torch.tanh(inputs[0] @ params["w"]) + torch.sin(inputs[0] @ params["u"]) - targets[index]
        ).square()

    return Examples((design,), losses, 0.3, {name: 0.5 * value for name, value in like.items()}), like, rows


@pytest.mark.parametrize("segments", [1, 3])
def test_it_is_autograd_through_the_whole_loop(generator, segments):
    examples, like, rows = _small(generator)
    rates = tuple(30 * rate for rate in RATES[:5])
    weights, design = (
        torch.ones(6, dtype=DOUBLE).requires_grad_(),
        examples.inputs[0].clone().requires_grad_(),
    )
    start, anchor = flatten(like), flatten(examples.anchor)
    state = RULE.begin(start)
    for done, index in enumerate(rows):
        point = state[0] if state[0].requires_grad else state[0].clone().requires_grad_()
        loss = (weights[index] * examples.losses(unflatten(point, like), (design[index],), index)).mean()
        loss = loss + 0.15 * (point - anchor).square().sum()
        (gradient,) = torch.autograd.grad(loss, point, create_graph=True)
        state = RULE.step((point, *state[1:]), gradient, rates[done], done)
    by_weight, by_input = torch.autograd.grad(state[0].square().sum(), (weights, design))
    made = train(RULE, start, rows, rates, lambda theta, index: examples.gradient(theta, like, index))
    if segments == 1:
        made = dataclasses.replace(made, checkpoints={0: made.checkpoints[0]})
    assert len(made.segments()) <= segments
    found = EXACT.accumulate(RecordedTraining(made, examples, like), 2.0 * made.end, generator, "inputs")
    torch.testing.assert_close(made.end, state[0].detach(), rtol=1e-13, atol=0.0)
    torch.testing.assert_close(found.images, by_weight, rtol=1e-11, atol=1e-14)
    torch.testing.assert_close(found.inputs[0], by_input, rtol=1e-11, atol=1e-14)


def test_an_unknown_product_and_a_slope_of_another_size_are_refused(micro):
    made = micro.trained(micro.examples)
    training = RecordedTraining(made, micro.examples, micro.like)
    with pytest.raises(ValueError, match=r"adjoint\.product"):
        next(reversed_steps(training, made.end, "sideways"))
    with pytest.raises(ValueError, match="slope"):
        next(reversed_steps(training, made.end[1:]))
    with pytest.raises(ValueError, match="proximal"):
        Examples((), micro.examples.losses, 0.1)
