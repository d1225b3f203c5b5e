"""The psi loop where photographs train beside the drawn images."""

import pytest
import torch

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.detector.cached import CachedSet
from neural_sim.detector.real import Real
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.training import Training
from neural_sim.gradient.accumulated import ProbeGroups, Unrolled
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.hypergradient import InnerProblem
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.unrolled import Examples
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule, curvature_rows
from neural_sim.outer.response import response
from neural_sim.outer.rewarded import RewardLoop
from neural_sim.outer.settings import Outer
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
        "iterations": 2, "images_per_object": 6, "epochs": 2, "steps": "free", "objective": "loss", "pool_per_bin": 2,
        "on_untrusted": "keep",
    }  # fmt: skip
    return InnerLoop(
        scene, DETECTOR, params, scene.training_set(psi, 3, generator).images,
        Outer(Mirror(shrink=False), **(settings | outer)), Training(batch_size=4, weight_decay=0.01, real=real),
        generator, draws, noise(photographs) if photographs else None,
    )  # fmt: skip


def module(scene, estimator, solver=None, **settings):
    inner = inner_loop(scene, estimator.draws, **settings)
    return SimulatorModule(inner, torch.zeros(2, 4), estimator, solver or SOLVER)


def test_a_training_set_is_the_drawn_images_and_then_the_photographs(scene):
    inner = inner_loop(scene, ReinforceEstimator().draws)
    images = inner.draw(torch.zeros(2, 4)).images
    cached = inner.training_set(images)
    drawn = CachedSet.of(inner.detector, inner.backbone, images)
    assert len(cached) == 12 + 5 and inner.drawn(cached) == 12
    assert torch.equal(cached.select(torch.arange(12)).targets.labels, drawn.targets.labels)
    photographs = CachedSet.of(inner.detector, inner.backbone, noise(5))
    for ours, theirs in zip(cached.features, photographs.features, strict=True):
        assert torch.equal(ours[12:], theirs)
    weights = inner.weights(cached)
    torch.testing.assert_close(weights, torch.tensor([0.5 / 12] * 12 + [0.5 / 5] * 5))
    losses = cached.losses(inner.trainable, torch.arange(17))
    assert inner.loss(cached) == pytest.approx(float(losses @ weights), rel=1e-5)


@pytest.mark.parametrize("adjoint", ["unrolled", "implicit"])
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
@pytest.mark.parametrize("batch_fraction", [0.5, None])
def test_every_estimator_moves_psi(scene, estimator, adjoint, batch_fraction):
    made = module(scene, estimator, real=Real("combined", batch_fraction=batch_fraction), adjoint=adjoint)
    learned = learn_psi(made, progress=False)
    # Two epochs of 12 drawn images in batches of 4, or of 17 images where photographs are images like others.
    assert [record.detector_steps for record in learned.records] == [6 if batch_fraction else 10] * 2
    assert [record.images for record in learned.records][1] <= 12 + 2 * 2 * 4  # photographs are not rendered
    assert bool(learned.last.isfinite().all()) and bool((learned.last != 0.0).any(1).all())


def test_the_loops_gradient_is_that_of_its_recorded_training(scene):
    """By hand: sum_b p_b s_b / objects from the sums over the steps, in which photographs have a part of each batch."""
    made = module(scene, StratifiedEstimator(2), unrolled=EXACT, epochs=3)
    inner = made.inner
    rendered = inner.draw(made.psi)
    cached = inner.training_set(rendered.images)
    inner.train(cached, made.settings.unrolled.recording)
    made._prepare()
    found, probed = made._derivative(rendered, cached), made._probes
    assert all(len(rows) == 4 and int((rows >= 12).sum()) == 2 for rows in inner.trajectory.rows)
    slope = gradient(inner.validation.mean_terms(), inner.trainable)
    tables = [part["pose"].index.view(4, 2) for part in probed.probes]
    whole = EXACT.accumulate(
        inner.trajectory, Examples(cached.inputs, cached.losses_from), inner.trainable, slope,
        torch.Generator(), ProbeGroups(probed.cached.losses, tables),
    )  # fmt: skip
    for name, table in zip(scene.names, tables, strict=True):
        psi = torch.zeros(4, requires_grad=True)
        mean = scene.distribution.factors[0].log_probabilities(psi).exp() @ whole.probes[table].mean(1)
        (expected,) = torch.autograd.grad(0.5 * 0.5 * mean, psi)  # half the objects, half of every batch
        torch.testing.assert_close(found.psi_gradients[name], expected, rtol=1e-3, atol=1e-6)


def test_the_implicit_problem_has_the_loss_of_the_training(scene, monkeypatch):
    made = module(scene, StratifiedEstimator(2), adjoint="implicit", curvature_images=8)
    problems = []
    original = InnerProblem.__post_init__
    monkeypatch.setattr(InnerProblem, "__post_init__", lambda self: (problems.append(self), original(self)))
    made.derivative()
    (problem,) = problems
    torch.testing.assert_close(problem.weights, torch.tensor([0.5 / 12] * 12 + [0.5 / 5] * 5))
    assert int((problem.subset >= 12).sum()) == 4 and len(problem.subset.unique()) == 8
    torch.testing.assert_close(problem.subset_weights, torch.full((8,), 1 / 8))


def test_rows_of_hessian_products_are_unbiased_for_the_loss_of_the_training(scene):
    inner = inner_loop(scene, ReinforceEstimator().draws, Real("combined", batch_fraction=0.25))
    cached = inner.training_set(inner.draw(torch.zeros(2, 4)).images)
    weights, generator = inner.weights(cached), torch.Generator().manual_seed(4)
    values = cached.losses(inner.trainable, torch.arange(17)).detach().double()
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
        inner = inner_loop(scene, StratifiedEstimator().draws, photographs=photographs)
        results.append(response(inner, torch.zeros(2, 4).double()).value)
    assert bool(results[0].isfinite().all()) and not torch.allclose(*results)


def test_methods_that_see_rewards_train_on_them_too(scene):
    method = LearningToSimulate("lts")
    losses = []
    for photographs in (5, 0):
        inner = inner_loop(scene, ReinforceEstimator().draws, photographs=photographs, iterations=1)
        learned = learn_psi(RewardLoop(inner, torch.zeros(2, 4), method), progress=False)
        losses.append(learned.records[0].training_loss)
    assert losses[0] != losses[1]


def test_checked_steps_compare_trainings_on_the_same_photographs(scene):
    """Under common random numbers the same psi gives the same training."""
    estimator = StratifiedEstimator(2)
    made = module(scene, estimator, steps="checked", objective="average_precision")
    made.inner.common_numbers = True
    psi, thetas = torch.zeros(2, 4), []
    for _ in range(2):
        made.inner.train(made.inner.training_set(made.inner.draw(psi).images))
        thetas.append(made.inner.trainable)
    assert all(torch.equal(thetas[0][name], thetas[1][name]) for name in thetas[0])
    assert len(learn_psi(made, progress=False).records) == 2
