"""The psi loop on the derivative of its own training."""

import dataclasses

import pytest
import torch

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.fcos import Fcos
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reversal import Examples, RecordedTraining
from neural_sim.gradient.unrolled import ProbeGroups, Unrolled
from neural_sim.outer.certificate import Trust
from neural_sim.outer.derivative import inputs_of
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.objective import Loss
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import Mirror
from neural_sim.parameter.zoom import Zoom
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.hvp import gradient

MICRO = {
    "backbone": Backbone("micro"), "anchors": Anchors(sizes=((14,), (28,)), reference=48), "head": Head(8, 1)
}  # fmt: skip
ESTIMATORS = [
    PathwiseEstimator(), PathwiseEstimator("reverse"), StratifiedEstimator(probes_per_bin=2), ReinforceEstimator()
]  # fmt: skip
EXACT = Unrolled("reverse_over_reverse", probes_per_step=0, scored_steps=0, floor=0.0)


def _module(scene, estimator, psi=None, **outer):
    generator = torch.Generator().manual_seed(0)
    detector, psi = RetinaNet(2, 32, **MICRO), torch.zeros(2, 4) if psi is None else psi
    params = detector.init(generator)
    settings = {
        "iterations": 2, "images_per_object": 6, "epochs": 2, "pool_per_bin": 2, "objective": Loss(),
        "steps": FreeSteps(Mirror(shrink=False)), "trust": Trust(on_untrusted="shrink"),
    }  # fmt: skip
    inputs = LoopInputs(detector, params, scene.training_set(psi, 3, generator).images)
    chosen, training = Outer(**(settings | outer)), Training(batch_size=4, weight_decay=0.01)
    inner = InnerLoop.prepare(scene, inputs, chosen, training, generator, estimator.draws)
    return SimulatorModule(inner, psi, estimator, AdjointSolver(), generator)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__ + getattr(e, "mode", ""))
def test_every_estimator_moves_psi_through_the_training(scene, estimator):
    joint = SceneDistribution.of([Pose(bins=3), Zoom(bins=2)])
    module = _module(dataclasses.replace(scene, distribution=joint), estimator, torch.zeros(2, 5))
    learned = learn_psi(module)
    assert len(learned.records) == 2
    for record in learned.records:
        # Two epochs of 12 images in batches of 4, each step walked back through.
        assert record.detector_steps == record.products == record.certificate.adjoint.reversed_steps == 6
        assert record.seconds["hypergradient_unrolled"] > 0.0
    assert torch.isfinite(learned.last).all()
    assert all((part.abs().amax(-1) > 0.0).all() for part in joint.split(learned.last).values())


def test_the_same_seed_gives_the_same_psi_bit_for_bit(scene):
    runs = [learn_psi(_module(scene, StratifiedEstimator(probes_per_bin=2))).last for _ in range(2)]
    assert torch.equal(*runs)


def test_objects_that_are_not_learned_are_not_scored(scene):
    module = _module(scene, StratifiedEstimator(probes_per_bin=2), learned=("b",))
    learned = learn_psi(module)
    assert not learned.last[0].any() and learned.last[1].any()


def _trained(scene, estimator, **settings):
    """A module, and a training of it that was recorded."""
    module = _module(scene, estimator, **settings)
    return module, module.train_on(module.psi, module.settings.adjoint.recording)


def test_the_loops_stratified_gradient_is_that_of_its_recorded_training(scene):
    """The same sums over the steps, and by hand the derivative of sum_b p_b s_b / objects."""
    module, trained = _trained(scene, StratifiedEstimator(2), adjoint=EXACT)
    module._prepare()
    found = module._derivative(trained, module.inner.objective)
    probed = module._probes
    slope = gradient(module.inner.objective.cached.mean_terms(), trained.trainable)
    tables = [part["pose"].index.view(4, 2) for part in probed.probes]
    examples = Examples(trained.examples.inputs, trained.examples.losses_from)
    recorded = RecordedTraining(trained.trajectory, examples, trained.trainable)
    groups = ProbeGroups(probed.cached.losses, tables)
    summed = EXACT.accumulate(recorded, slope, torch.Generator(), probes=groups)
    for name, table in zip(scene.names, tables, strict=True):
        psi = torch.zeros(4, requires_grad=True)
        mean = scene.distribution.factors[0].log_probabilities(psi).exp() @ summed.probes[table].mean(1)
        (expected,) = torch.autograd.grad(0.5 * mean, psi)
        torch.testing.assert_close(found.gradients[name], expected, rtol=1e-3, atol=1e-6)
    assert found.adjoint.validation_norm == pytest.approx(float(slope.norm()))


def test_inputs_are_made_again_of_images(scene):
    module, trained = _trained(scene, PathwiseEstimator())
    rows = torch.tensor([5, 0, 11])
    made = inputs_of(module.inner, trained.examples)(trained.rendered.images.images[rows], rows)
    for again, kept in zip(made, trained.examples.inputs, strict=True):
        torch.testing.assert_close(again, kept[rows], rtol=1e-4, atol=1e-5)


def test_forward_and_reverse_mode_agree_through_the_training(scene):
    """The scene's tangents and the paper's second forward, both in float32, from one training."""
    module, trained = _trained(scene, PathwiseEstimator(), adjoint=EXACT)
    forward = module._derivative(trained, module.inner.objective)
    bare = tuple(dataclasses.replace(part, tangents=None) for part in trained.rendered.objects)
    without = dataclasses.replace(trained, rendered=dataclasses.replace(trained.rendered, objects=bare))
    reverse = module._derivative(without, module.inner.objective)
    for name in scene.names:
        one, other = forward.gradients[name], reverse.gradients[name]
        assert float((one - other).norm()) < 1e-3 * float(other.norm())


def test_a_training_that_was_not_recorded_is_refused(scene):
    module = _module(scene, ReinforceEstimator())
    with pytest.raises(ValueError, match="was not recorded"):
        module._derivative(module.train_on(module.psi), module.inner.objective)


@pytest.mark.parametrize("settings", [{"train_first": False}, {"epochs": 0}])
def test_unrolling_wants_a_training_in_every_iteration(settings):
    with pytest.raises(ValueError, match=r"outer/adjoint=unrolled wants"):
        Outer(steps=FreeSteps(), **settings)


@pytest.mark.parametrize(
    ("kind", "estimator", "adjoint"),
    [
        *(("fcos", ESTIMATORS[2], adjoint) for adjoint in (Unrolled(), Implicit())),
        *zip(["classifier"] * 4, ESTIMATORS, [Unrolled(), Implicit(), Unrolled(), Implicit()], strict=True),
    ],
)
def test_detectors_of_other_kinds_go_through_the_same_loop(scene, adjoint, kind, estimator):
    """With checked steps, and the smooth score as the objective: AP, whose ranks count FCOS's centre-ness, or a
    classifier's accuracy."""
    generator, psi = torch.Generator().manual_seed(0), torch.zeros(2, 4)
    detector = {
        "fcos": Fcos(2, 32, Backbone("micro"), Head(8, 1)), "classifier": Classifier(2, 32, Backbone("micro")),
    }[kind]  # fmt: skip
    settings = Outer(
        iterations=2,
        images_per_object=6,
        epochs=2,
        pool_per_bin=2,
        adjoint=adjoint,
        objective=SmoothAccuracy() if kind == "classifier" else SmoothAP(),
        trust=Trust(on_untrusted="keep"),
    )
    params = detector.init(generator)
    inputs = LoopInputs(detector, params, scene.training_set(psi, 3, generator).images)
    inner = InnerLoop.prepare(scene, inputs, settings, Training(batch_size=4), generator, estimator.draws)
    module = SimulatorModule(inner, psi, estimator, AdjointSolver(), generator)
    learned = learn_psi(module)
    norms = torch.tensor(learned.records[0].gradient_norms)
    assert len(learned.records) == 2 and bool(norms.isfinite().all()) and bool(norms.any())
    assert bool(module.psi.isfinite().all()) and learned.records[1].verdicts
