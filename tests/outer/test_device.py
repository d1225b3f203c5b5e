"""The psi loop with its scene and detector on another device."""

import copy
import dataclasses

import pytest
import torch
from small_loop import CHECKED, FREE
from trips import counted

from neural_sim import devices
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reversal import Examples, RecordedTraining
from neural_sim.gradient.unrolled import ProbeGroups, Unrolled
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.solver.hvp import HessianOperator
from neural_sim.solver.operator import Shifted
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.synthesizer import Synthesizer

TINY = {
    "num_classes": 2, "image_size": 32, "anchors": Anchors(sizes=((10,), (18,)), reference=32), "head": Head(8, 1),
    "backbone": Backbone("micro"),
}  # fmt: skip


def _module(scene, estimator, device, epochs=1, iterations=1, **outer):
    generator = torch.Generator().manual_seed(0)
    detector, psi = RetinaNet(**TINY), torch.zeros(2, 4)
    scene = dataclasses.replace(
        scene,
        subjects=tuple(
            dataclasses.replace(subject, field=copy.deepcopy(subject.field).to(device))
            for subject in scene.fields
        ),
        synthesizer=Synthesizer(ProceduralClutter(octaves=1, shapes=1), shift=0.1),
    )
    validation = scene.training_set(psi, 3, generator).images.to("cpu")
    free = FREE | {"adjoint": Implicit(curvature_images=4)}
    settings = Outer(
        iterations=iterations, images_per_object=4, epochs=epochs, pool_per_bin=2, **(free | outer)
    )
    params = devices.placed(detector.init(generator), torch.device(device))
    inputs, training = LoopInputs(detector, params, validation), Training(batch_size=4, weight_decay=0.0)
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator, estimator.draws)
    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=2), max_steps=3)
    return SimulatorModule(inner, psi, estimator, solver, generator)


def _estimators(fast: int):
    """Parametrize a test by all estimators; all but one of them are slow tests."""
    of = [
        StratifiedEstimator(probes_per_bin=1),
        PathwiseEstimator(),
        ReinforceEstimator(),
        PathwiseEstimator("reverse"),
    ]
    marks = [() if number == fast else pytest.mark.slow for number in range(len(of))]
    names = [type(one).__name__ + getattr(one, "mode", "") for one in of]
    return pytest.mark.parametrize(
        "estimator",
        [pytest.param(one, marks=mark, id=name) for one, mark, name in zip(of, marks, names, strict=True)],
    )


@_estimators(fast=1)
def test_the_loop_is_the_cpus(scene, pretend, monkeypatch, estimator):
    monkeypatch.setattr(devices, "CACHES", 1)  # sums in the CPU's pieces have its rounding
    found = []
    for device in ("cpu", "pretend"):
        module = _module(scene, estimator, device)
        found.append(learn_psi(module))
        assert {value.device.type for value in module.theta.values()} == {device}
        assert module.psi.device.type == "cpu"
    # Up to the rounding of second derivatives, which the device takes by formulas where the CPU has kernels.
    assert found[1].last == pytest.approx(found[0].last, rel=1e-3, abs=1e-4)
    losses = [[record.validation_loss for record in learned.records] for learned in found]
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)


@_estimators(fast=0)
def test_the_loop_on_the_trainings_derivative_is_the_cpus(scene, pretend, monkeypatch, estimator):
    monkeypatch.setattr(devices, "CACHES", 1)
    found = []
    for device in ("cpu", "pretend"):
        module = _module(scene, estimator, device, epochs=2, adjoint=Unrolled(), train_first=True)
        found.append(learn_psi(module))
        assert next(iter(module.theta.values())).device.type == device
    assert found[1].last == pytest.approx(found[0].last, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("scored", [False, True])
def test_steps_walked_back_through_wait_for_nothing(scene, pretend, scored):
    """Scores of probes bring their columns there and wait twice, for a difference's length; steps alone do neither."""
    trips = {}
    for epochs in (1, 3):
        module = _module(scene, ReinforceEstimator(), "pretend", epochs, adjoint=Unrolled(), train_first=True)
        trained = module.train_on(module.psi, module.settings.adjoint.recording)
        cached = trained.examples
        examples = Examples(cached.inputs, cached.losses_from)
        recorded = RecordedTraining(trained.trajectory, examples, trained.trainable)
        probes = ProbeGroups(cached.losses, [torch.arange(6).view(2, 3)]) if scored else None
        slope = torch.ones_like(trained.trajectory.end)
        with counted() as ledger:
            Unrolled(scored_steps=0).accumulate(recorded, slope, torch.Generator(), probes=probes)
        trips[recorded.steps] = ledger.count()
    assert trips == {2: trips[2], 6: trips[2] + 4 * (2 + 1) * scored}


def test_detector_steps_wait_for_nothing(scene, pretend):
    """Each epoch brings its order to the device; all else is once a training, however many steps."""
    trips = {}
    for epochs in (1, 5):
        module = _module(scene, StratifiedEstimator(probes_per_bin=1), "pretend", epochs)
        with counted() as ledger:
            module.train_on(module.psi)
        trips[epochs] = ledger
    assert trips[5].count("to_device") - trips[1].count("to_device") == 4
    assert trips[5].count("wait", "to_host") == trips[1].count("wait", "to_host")


def test_a_product_of_conjugate_gradients_waits_twice(scene, pretend):
    module = _module(scene, StratifiedEstimator(probes_per_bin=1), "pretend")
    inner, generator = module.inner, torch.Generator().manual_seed(0)
    operator = HessianOperator(inner.objective.cached.mean_terms(), inner.warm_start, retain_graph=True)
    b = torch.randn(operator.size, generator=generator).to("pretend")
    trips = {}
    for steps in (2, 6):
        with counted() as ledger:
            solution = ConjugateGradient().solve(Shifted(operator, 100.0), b, rtol=0.0, max_steps=steps)
        trips[solution.products] = ledger.count()
    (few, first), (many, last) = trips.items()
    assert many - few == 4 and last - first == 2 * 4


def test_images_and_features_stay_on_the_device(scene, pretend):
    """What returns to the CPU in an iteration are numbers: less than one image of the training set."""
    module = _module(scene, StratifiedEstimator(probes_per_bin=1), "pretend")
    with counted() as ledger:
        module.training_step(0, 0)
    back = sum(size for (kind, _, _), size in ledger.moved.items() if kind == "to_host")
    assert back < 3 * 32 * 32 * 4


def test_the_checked_loop_of_average_precision_is_the_cpus(scene, pretend, monkeypatch):
    monkeypatch.setattr(devices, "CACHES", 1)
    found = []
    for device in ("cpu", "pretend"):
        module = _module(scene, StratifiedEstimator(probes_per_bin=1), device, epochs=2, **CHECKED)
        found.append(learn_psi(module))
    assert found[1].last == pytest.approx(found[0].last, rel=1e-3, abs=1e-4)
    scores = [[record.scores for record in learned.records] for learned in found]
    assert scores[1][0] == pytest.approx(scores[0][0], rel=1e-4)
