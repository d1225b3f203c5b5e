"""The psi loop where photographs train beside the drawn images."""

import pytest
import torch

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.real import Real
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.smooth_scores import SmoothAP
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit, InnerProblem, curvature_rows
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reversal import Examples, RecordedTraining
from neural_sim.gradient.unrolled import ProbeGroups, Unrolled
from neural_sim.outer.certificate import Trust
from neural_sim.outer.inner import InnerLoop, LoopInputs, Numbers
from neural_sim.outer.loop import RewardLoop, learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.objective import Loss
from neural_sim.outer.response import response
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.parameter.update import Mirror
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.solver.hvp import gradient
from neural_sim.types import LabelledImages

DETECTOR = RetinaNet(2, 32, Backbone("micro"), Head(8, 1), Anchors(sizes=((14,), (28,)), reference=48))
ESTIMATORS = [PathwiseEstimator(), StratifiedEstimator(probes_per_bin=2), ReinforceEstimator()]
EXACT = Unrolled("reverse_over_reverse", probes_per_step=0, scored_steps=0, floor=0.0)
SOLVER = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=6), max_steps=6)


def noise(count, seed=9):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 1, 2, generator=generator) * 14
    boxes = torch.cat([corner, corner + 6 + 10 * torch.rand(count, 1, 2, generator=generator)], -1)
    labels = torch.randint(0, 2, (count, 1), generator=generator)
    return LabelledImages(
        torch.rand(count, 3, 32, 32, generator=generator), boxes, labels, torch.full((count,), -1)
    )


COMBINED = Real("combined")


def inner_loop(scene, draws, real=COMBINED, photographs=5, seed=0, **outer):
    generator = torch.Generator().manual_seed(seed)
    params, psi = DETECTOR.init(generator), torch.zeros(2, 4)
    settings = {
        "iterations": 2, "images_per_object": 6, "epochs": 2, "pool_per_bin": 2, "objective": Loss(),
        "steps": FreeSteps(Mirror(shrink=False)), "trust": Trust(on_untrusted="keep"),
    }  # fmt: skip
    validation = scene.training_set(psi, 3, generator).images
    inputs = LoopInputs(DETECTOR, params, validation, noise(photographs) if photographs else None)
    training = Training(batch_size=4, weight_decay=0.01, real=real)
    return InnerLoop.prepare(
        scene, inputs, Outer(**(settings | outer)), training, generator, draws
    ), generator


def module(scene, estimator, solver=None, **settings):
    inner, generator = inner_loop(scene, estimator.draws, **settings)
    return SimulatorModule(inner, torch.zeros(2, 4), estimator, solver or SOLVER, generator)


def test_a_training_set_is_the_drawn_images_and_then_the_photographs(scene):
    inner, generator = inner_loop(scene, ReinforceEstimator().draws)
    images = inner.draw(torch.zeros(2, 4), Numbers(generator)).images
    cached = inner.training_set(images)
    drawn = CachedSet.of(inner.detector, inner.backbone, images)
    assert len(cached) == 12 + 5
    assert torch.equal(cached.select(torch.arange(12)).targets.labels, drawn.targets.labels)
    photographs = CachedSet.of(inner.detector, inner.backbone, noise(5))
    for ours, theirs in zip(cached.features, photographs.features, strict=True):
        assert torch.equal(ours[12:], theirs)
    weights = inner.weights(cached)
    torch.testing.assert_close(weights, torch.tensor([0.5 / 12] * 12 + [0.5 / 5] * 5))
    losses = cached.losses(inner.warm_start, torch.arange(17))
    assert inner.loss(cached, inner.params) == pytest.approx(float(losses @ weights), rel=1e-5)


@pytest.mark.parametrize(
    ("estimator", "adjoint", "batch_fraction"),
    [
        (estimator, adjoint, 0.5 if (number + isinstance(adjoint, Implicit)) % 2 else None)
        for number, estimator in enumerate(ESTIMATORS)
        for adjoint in (Unrolled(), Implicit())
    ],
    ids=lambda value: (
        type(value).__name__ if isinstance(value, (*map(type, ESTIMATORS), Unrolled, Implicit)) else None
    ),
)
def test_every_estimator_moves_psi(scene, estimator, adjoint, batch_fraction):
    """Every pair of an estimator, an adjoint and a part of the batches."""
    made = module(scene, estimator, real=Real("combined", batch_fraction=batch_fraction), adjoint=adjoint)
    learned = learn_psi(made)
    # Two epochs of 12 drawn images in batches of 4, or of 17 images where photographs are images like others.
    assert [record.detector_steps for record in learned.records] == [6 if batch_fraction else 10] * 2
    assert [record.images for record in learned.records][1] <= 12 + 2 * 2 * 4  # photographs are not rendered
    assert bool(learned.last.isfinite().all()) and bool((learned.last != 0.0).any(1).all())


def test_the_loops_gradient_is_that_of_its_recorded_training(scene):
    """By hand: sum_b p_b s_b / objects from the sums over the steps, in which photographs have a part of each batch."""
    made = module(scene, StratifiedEstimator(2), adjoint=EXACT, epochs=3)
    trained = made.train_on(made.psi, EXACT.recording)
    made._prepare()
    found, probed = made._derivative(trained, made.inner.objective), made._probes
    assert all(len(rows) == 4 and int((rows >= 12).sum()) == 2 for rows in trained.trajectory.rows)
    slope = gradient(made.inner.objective.cached.mean_terms(), trained.trainable)
    tables = [part["pose"].index.view(4, 2) for part in probed.probes]
    examples = Examples(trained.examples.inputs, trained.examples.losses_from)
    recorded = RecordedTraining(trained.trajectory, examples, trained.trainable)
    groups = ProbeGroups(probed.cached.losses, tables)
    whole = EXACT.accumulate(recorded, slope, torch.Generator(), probes=groups)
    for name, table in zip(scene.names, tables, strict=True):
        psi = torch.zeros(4, requires_grad=True)
        mean = scene.distribution.factors[0].log_probabilities(psi).exp() @ whole.probes[table].mean(1)
        (expected,) = torch.autograd.grad(0.5 * 0.5 * mean, psi)  # half the objects, half of every batch
        torch.testing.assert_close(found.gradients[name], expected, rtol=1e-3, atol=1e-6)


def test_the_implicit_problem_has_the_loss_of_the_training(scene, monkeypatch):
    made = module(scene, StratifiedEstimator(2), adjoint=Implicit(curvature_images=8))
    problems = []
    original = InnerProblem.__post_init__
    monkeypatch.setattr(InnerProblem, "__post_init__", lambda self: (problems.append(self), original(self)))
    made.derivative()
    (problem,) = problems
    torch.testing.assert_close(problem.weights, torch.tensor([0.5 / 12] * 12 + [0.5 / 5] * 5))
    assert int((problem.subset >= 12).sum()) == 4 and len(problem.subset.unique()) == 8
    torch.testing.assert_close(problem.subset_weights, torch.full((8,), 1 / 8))


def test_rows_of_hessian_products_are_unbiased_for_the_loss_of_the_training(scene):
    inner, drawn = inner_loop(scene, ReinforceEstimator().draws, Real("combined", batch_fraction=0.25))
    cached = inner.training_set(inner.draw(torch.zeros(2, 4), Numbers(drawn)).images)
    weights, generator = inner.weights(cached), torch.Generator().manual_seed(4)
    values = cached.losses(inner.warm_start, torch.arange(17)).detach().double()
    truth, found = float(values @ weights.double()), []
    for _ in range(4000):
        rows, own = curvature_rows(12, weights, 8, generator)
        found.append(float(values[rows] @ own.double()))
    found = torch.tensor(found)
    assert (
        abs(float(found.mean()) - truth) < 5 * float(found.std()) / 4000**0.5
    )  # of a normal mean: one in a million
    assert len(curvature_rows(12, weights, 0, generator)[0]) == 17
    few, own = curvature_rows(12, torch.full((12,), 1 / 12), 8, generator)
    assert len(few) == 8 and torch.allclose(own, torch.full((8,), 1 / 8))


def test_photographs_change_the_training_and_the_response_to_psi(scene):
    results = []
    for photographs in (5, 0):
        inner, generator = inner_loop(scene, StratifiedEstimator().draws, photographs=photographs)
        results.append(response(inner, torch.zeros(2, 4).double(), Numbers(generator)).value)
    assert bool(results[0].isfinite().all()) and not torch.allclose(*results)


def test_methods_that_see_rewards_train_on_them_too(scene):
    method = LearningToSimulate("lts")
    losses = []
    for photographs in (5, 0):
        inner, generator = inner_loop(
            scene, ReinforceEstimator().draws, photographs=photographs, iterations=1
        )
        learned = learn_psi(RewardLoop(inner, torch.zeros(2, 4), method, generator))
        losses.append(learned.records[0].training_loss)
    assert losses[0] != losses[1]


def test_checked_steps_compare_trainings_on_the_same_photographs(scene):
    """Under common random numbers the same psi gives the same training."""
    estimator = StratifiedEstimator(2)
    made = module(scene, estimator, steps=TrustRegion(), objective=SmoothAP())
    one, other = (made.train_on(torch.zeros(2, 4)).trainable for _ in range(2))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert len(learn_psi(made).records) == 2
