"""What is summed over a training's steps, and what every estimator makes of it."""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from recorded_training import DOUBLE, EXACT, STEP, Micro, extrapolated

from neural_sim.detector.losses import Targets
from neural_sim.detector.real import shuffled_passes
from neural_sim.detector.trajectory import AdamW, train
from neural_sim.gradient.base import ObjectImages, Probes
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator, reinforce, stratified
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reversal import Examples, RecordedTraining, reversed_steps
from neural_sim.gradient.significance import no_difference
from neural_sim.gradient.unrolled import Accumulated, ProbeGroups, Unrolled, step_weights
from neural_sim.parameter.bins import closing
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.solver.operator import flatten, unflatten
from neural_sim.types import SceneDraw

RULE = AdamW(0.05)
BINS = torch.arange(4).repeat_interleave(2)
DISTRIBUTION = SceneDistribution.of([Pose(bins=4)])
PSI = torch.tensor([0.4, -0.3, 0.1, -0.8], dtype=DOUBLE)
GROUP = torch.arange(8).view(4, 2)  # the micro problem's eight images as probes: two of each of four bins


@pytest.fixture(scope="module")
def micro():
    return Micro()


def images_of(weights):
    zeros = torch.zeros(len(weights), dtype=DOUBLE)
    draw = SceneDraw(zeros, zeros, zeros + 3.0, BINS[:, None])
    images = zeros[:, None, None, None].expand(-1, 3, 1, 1)
    return ObjectImages(PSI, DISTRIBUTION, images, torch.arange(len(weights)), weights, draw)


def all_scores(micro, made):
    """Every image's score in every step, one after the other."""
    steps = reversed_steps(
        RecordedTraining(made, micro.examples, micro.like), micro.slope(made.end), "reverse_over_reverse"
    )
    every = []
    for step in steps:
        _, along = torch.func.jvp(
            lambda p: micro.cached.losses(p, torch.arange(8)), (step.params,), (step.along,)
        )
        every.append(along)
    return torch.stack(every)


def up_to_a_constant(values):
    return values - values.mean(-1, keepdim=True)


@pytest.mark.parametrize("per_step", [0, 5])  # 5: more than there are
def test_all_probes_in_all_steps_are_the_sum_of_their_scores(micro, per_step):
    made = micro.trained(micro.examples)
    how = dataclasses.replace(EXACT, probes_per_step=per_step, chunk_size=3)
    found = micro.accumulated(how, probes=ProbeGroups(micro.cached.losses, [GROUP]))
    expected = up_to_a_constant(all_scores(micro, made).sum(0))
    assert found.scored == 6 * 8
    # Probes are scored by central differences: eps^(2/3) times third derivatives of the losses.
    assert float((up_to_a_constant(found.probes) - expected).norm()) < 1e-7 * float(expected.norm())


@pytest.mark.parametrize(("per_step", "every"), [(1, 1), (1, 2), (1, 4), (2, 3)])
def test_a_few_probes_a_step_are_unbiased(micro, per_step, every):
    """The mean of the bins' means over many draws lies within four standard errors of all scores' sum."""
    made = micro.trained(micro.examples)
    scores = all_scores(micro, made)
    expected = up_to_a_constant(scores.sum(0).view(4, 2).mean(1))
    generator, drawn = torch.Generator().manual_seed(11), []
    for _ in range(1500):
        total, turns = torch.zeros(4, dtype=DOUBLE), shuffled_passes(2, per_step, generator)
        for row, weight in zip(scores, step_weights(6, every, generator), strict=True):
            if weight:
                total += weight * up_to_a_constant(row.view(4, 2)[:, next(turns)].mean(1))
        drawn.append(total)
    drawn = torch.stack(drawn)
    error = drawn.std(0) / len(drawn) ** 0.5
    assert ((drawn.mean(0) - expected).abs() < 4.0 * error + 1e-12).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_walk_scores_the_probes_that_were_drawn(micro, seed):
    """The same draw of places and steps, by hand from all scores; two groups share places and keep their own means."""
    made = micro.trained(micro.examples)
    scores = all_scores(micro, made)
    # Blocks of 6 / 4 steps on average, rounded up.
    how = Unrolled("reverse_over_reverse", probes_per_step=1, scored_steps=4, floor=0.0)
    groups = [GROUP[:2], GROUP[2:]]
    found = how.accumulate(
        RecordedTraining(made, micro.examples, micro.like), micro.slope(made.end),
        torch.Generator().manual_seed(seed), probes=ProbeGroups(micro.cached.losses, groups),
    )  # fmt: skip
    generator, total = torch.Generator().manual_seed(seed), torch.zeros(8, dtype=DOUBLE)
    turns, levels = shuffled_passes(2, 1, generator), None
    for row, weight in zip(scores, step_weights(6, 2, generator), strict=True):
        if weight:
            rows = [table[:, chosen].reshape(-1) for chosen in [next(turns)] for table in groups]
            means = [row[part].mean() for part in rows]
            for part, level in zip(rows, levels or means, strict=True):
                total[part] += weight * 2 * (row[part] - level)
            levels = means
    assert found.scored == 3 * 4
    torch.testing.assert_close(found.probes, total, rtol=1e-6, atol=1e-6 * float(total.abs().max()))


def test_every_place_has_its_turn(generator):
    turns = list(itertools.islice(shuffled_passes(5, 2, generator), 10))
    assert torch.bincount(torch.cat(turns), minlength=5).tolist() == [4] * 5


def test_blocks_of_steps_grow_and_weigh_what_they_stand_for(generator):
    assert list(step_weights(4, 1, generator)) == [1, 1, 1, 1]
    drawn = torch.tensor([list(step_weights(12, 2, generator)) for _ in range(3000)]).flip(1)
    assert (drawn.sum(1) == 12).all()
    for step, length in enumerate(4 * [1] + 2 * [2] + 6 * [3]):
        assert set(drawn[:, step].tolist()) == ({0, length} if length > 1 else {1})
    error = drawn.double().std(0) / 3000**0.5  # every step counts once on average
    assert ((drawn.double().mean(0) - 1.0).abs() <= 4.0 * error).all()


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_standard_error_counts_the_probes_and_the_few_that_are_scored(generator, every):
    """Losses linear in theta, whose scores are products with a_t: their slopes vary around each bin's own.

    120 draws tell the spread within 7 %; the estimate lies above it by what the bins' means change from step to step.
    """
    bins, per_bin, steps = 4, 6, 12
    slopes = torch.randn(bins, 3, generator=generator, dtype=DOUBLE)
    design = torch.randn(5, 3, generator=generator, dtype=DOUBLE)
    like = {"w": torch.ones(3, dtype=DOUBLE)}
    examples = Examples((design,), lambda p, x, rows: torch.tanh(x[0] @ p["w"]).square())
    rows = tuple(torch.randperm(5, generator=generator)[:2] for _ in range(steps))
    made = train(
        RULE, like["w"], rows, (0.02,) * steps, lambda theta, index: examples.gradient(theta, like, index)
    )
    strata, how = torch.arange(bins).repeat_interleave(per_bin), Unrolled(scored_steps=12 // every)
    values, errors = [], []
    for _ in range(120):
        drawn = slopes[strata] + torch.randn(bins * per_bin, 3, generator=generator, dtype=DOUBLE)

        def losses(params, index, drawn=drawn):
            return drawn[index] @ params["w"]

        found = how.accumulate(
            RecordedTraining(made, examples, like), torch.ones(3, dtype=DOUBLE), generator,
            probes=ProbeGroups(losses, [torch.arange(bins * per_bin).view(bins, per_bin)]),
        )  # fmt: skip
        part = stratified(found.probes.view(bins, per_bin), PSI, lambda psi: torch.log_softmax(psi, -1))
        values.append(part.value)
        errors.append(part.standard_error)
    ratio = torch.stack(errors).square().mean(0).sqrt() / torch.stack(values).std(0)
    assert ((ratio > 0.8) & (ratio < 1.35)).all()


def test_stratified_is_the_derivative_over_hard_bins_of_the_training_that_was_run(micro):
    """Each step minimises sum_b p_b(psi) mean_b l over images of all bins: nothing is drawn, so that psi moves the
    outcome smoothly and the central difference is exact."""
    every = tuple(torch.arange(8) for _ in range(6))

    def problem(psi):
        p = DISTRIBUTION.factors[0].log_probabilities(psi).exp()
        weights = 4.0 * p[BINS]  # the mean over eight images is then sum_b p_b mean_b
        return micro.weighted(weights)

    def trained(psi):
        rates, examples = (3e-3, 2e-3, 3e-3, 2e-3, 1e-3, 1e-3), problem(psi)
        return train(
            RULE,
            flatten(micro.like),
            every,
            rates,
            lambda theta, rows: examples.gradient(theta, micro.like, rows),
        )

    made = trained(PSI)
    how = dataclasses.replace(EXACT, probes_per_step=0)
    found = how.accumulate(
        RecordedTraining(made, problem(PSI), micro.like), micro.slope(made.end), torch.Generator().manual_seed(0),
        probes=ProbeGroups(micro.cached.losses, [GROUP]),
    )  # fmt: skip
    images = images_of(torch.full((8,), 1 / 8, dtype=DOUBLE))
    ours = StratifiedEstimator(2).accumulated(found, images, {"pose": Probes(torch.arange(8), BINS)}).value
    expected = [
        extrapolated(lambda step, e=e: micro.outer(trained(PSI + step * e).end), STEP)
        for e in torch.eye(4, dtype=DOUBLE)
    ]
    expected = torch.tensor(expected, dtype=DOUBLE)
    assert float((ours - expected).norm()) < 1e-6 * float(expected.norm())


def test_closed_bins_have_no_part_in_the_test_of_stratified_scores():
    """Renders of bins that no photograph shows have scores far from the others', which moves nothing."""
    closed = torch.tensor([False, True, False, False])
    images = dataclasses.replace(images_of(torch.full((8,), 1 / 8, dtype=DOUBLE)), psi=closing(PSI, closed))
    scored = torch.randn(4, 12, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    scored = scored + 100.0 * closed[:, None]
    probes = {"pose": Probes(torch.arange(48), torch.arange(4).repeat_interleave(12))}
    sums = Accumulated(torch.zeros(0), (), scored.flatten(), 48)
    found = StratifiedEstimator(12).accumulated(sums, images, probes)
    assert found.p_values["pose"] == no_difference(scored[~closed].T) > 0.05
    assert found.value[1] == 0.0 != found.value[0]


def test_the_score_function_takes_the_derivative_by_the_images_weights(micro):
    found = micro.accumulated()
    images = images_of(torch.full((8,), 1 / 8, dtype=DOUBLE))
    ours = ReinforceEstimator().accumulated(found, images, {})
    theirs = reinforce(8.0 * found.images, lambda psi: DISTRIBUTION.log_prob(psi, images.draw), PSI, 1.0)
    torch.testing.assert_close(ours.value, theirs.value)
    torch.testing.assert_close(ours.standard_error, theirs.standard_error)


def test_pathwise_is_the_derivative_of_the_training_on_images_that_move(problem, generator):
    """psi moves every image of ridge regression on rendered pixels: the same training at psi +- h, noise replayed."""
    rows = tuple(part for _ in range(3) for part in torch.randperm(7, generator=generator).split(3))
    start = {name: 0.1 * torch.ones_like(value) for name, value in problem.minimiser(problem.psi).items()}
    rates = tuple(0.05 - 0.005 * step for step in range(9))
    anchor = {name: torch.zeros_like(value) for name, value in start.items()}

    def examples(psi):
        images = problem.images(psi).detach()
        return Examples(
            (images,), lambda p, inputs, index: problem.loss_of(p, inputs[0], index), 0.3, anchor,
            lambda images, index: (images,),
        )  # fmt: skip

    def trained(psi):
        held = examples(psi)
        return train(
            RULE, flatten(start), rows, rates, lambda theta, index: held.gradient(theta, start, index)
        )

    def outer(theta):
        return problem.validation(unflatten(theta, start))

    made = trained(problem.psi)
    point = made.end.clone().requires_grad_()
    (slope,) = torch.autograd.grad(outer(point), point)
    found = EXACT.accumulate(RecordedTraining(made, examples(problem.psi), start), slope, generator, "inputs")
    ours = PathwiseEstimator(chunk_size=3).accumulated(found, problem.object_images(), {}).value
    expected = [
        extrapolated(lambda step, e=e: float(outer(trained(problem.psi + step * e).end)), STEP)
        for e in torch.eye(4, dtype=DOUBLE)
    ]
    expected = torch.tensor(expected, dtype=DOUBLE)
    assert float((ours - expected).norm()) < 1e-6 * float(expected.norm())


def test_pathwise_goes_through_the_backbone_once_for_all_steps(pipeline):
    """Pixels, features, six steps of the detector's pyramid and head: against the same training at psi +- h."""
    rates, every = (3e-3, 5e-3, 4e-3, 2e-3), [torch.tensor([0, 2]), torch.tensor([1, 3])] * 2
    labels = pipeline.targets.labels

    def inputs_of(images, rows):
        return (*pipeline.detector.features(pipeline.backbone, images), pipeline.targets.deltas[rows])

    def losses(params, inputs, rows):
        return pipeline.detector.per_image_loss(params, inputs[:-1], Targets(labels[rows], inputs[-1]))

    def trained(psi):
        with torch.no_grad():
            images = pipeline.compose(*pipeline.render(psi)).images
            inputs = inputs_of(images, torch.arange(len(images)))
        held = Examples(inputs, losses, inputs_of=inputs_of)
        made = train(
            RULE, flatten(pipeline.trainable), tuple(every), rates,
            lambda theta, rows: held.gradient(theta, pipeline.trainable, rows),
        )  # fmt: skip
        return made, held

    direction = flatten(pipeline.vector)
    made, held = trained(pipeline.psi)
    found = EXACT.accumulate(
        RecordedTraining(made, held, pipeline.trainable), direction, torch.Generator(), "inputs"
    )
    ours = PathwiseEstimator(chunk_size=3).accumulated(found, pipeline.object_images(), {}).value
    along = torch.tensor([1.0, -0.5, 0.3, -0.8], dtype=DOUBLE)
    expected = extrapolated(
        lambda step: float(trained(pipeline.psi + step * along)[0].end @ direction), 10 * STEP
    )
    assert float(ours @ along) == pytest.approx(expected, rel=1e-5)


def test_pathwise_wants_the_derivative_by_inputs(problem):
    nothing = Accumulated(torch.zeros(7), (), torch.zeros(0), 0)
    with pytest.raises(ValueError, match="was not accumulated"):
        PathwiseEstimator().accumulated(nothing, problem.object_images(), {})
    with pytest.raises(ValueError, match="no rendered path"):
        PathwiseEstimator().accumulated(nothing, dataclasses.replace(problem.object_images(), path=None), {})


@pytest.mark.parametrize(
    "settings",
    [{"product": "dense"}, {"max_memory_mb": -1.0}, {"probes_per_step": -1}, {"scored_steps": -1},
     {"chunk_size": 0}, {"floor": -0.1}, {"floor": float("nan")}],
)  # fmt: skip
def test_nonsense_is_refused(settings):
    with pytest.raises(ValueError, match=rf"Unrolled\.{next(iter(settings))}"):
        Unrolled(**settings)


@pytest.mark.usefixtures("wrong_shapes")
@pytest.mark.parametrize("groups", [[], [GROUP, GROUP[:, :1]], [GROUP[:, :0]], [torch.arange(4)]])
def test_tables_of_probes_want_one_width(micro, groups):
    with pytest.raises(ValueError, match="per_bin"):
        ProbeGroups(micro.cached.losses, groups)
