"""Every adjoint is compared with the response of the same training; a derivative that equals it has no error."""

from types import SimpleNamespace

import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.response import Response
from neural_sim.outer.settings import Outer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.damping import LanczosDamping
from neural_sim.solver.operator import flatten
from neural_sim.studies.work_precision import hypergradient as family
from neural_sim.studies.work_precision.hypergradient import (
    DEFAULT,
    EXACT,
    Hypergradients,
    centred_error,
    correlation,
    slopes,
    ways,
)
from neural_sim.studies.work_precision.measurement import Timing
from neural_sim.studies.work_precision.solver import PSI, small_scene

SOLVER = AdjointSolver(damping=LanczosDamping(lanczos_steps=4), max_steps=4)
OUTER = Outer(iterations=2, images_per_object=6, epochs=1, pool_per_bin=2)


def simulator(outer, solver, seed, psi=None):
    psi = PSI if psi is None else psi
    generator, scene = torch.Generator().manual_seed(seed), small_scene()
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    validation = scene.training_set(PSI, 3, generator).images
    inputs = LoopInputs(detector, detector.init(generator), validation)
    inner = InnerLoop.prepare(scene, inputs, outer, Training(batch_size=4), generator)
    return SimulatorModule(inner, psi, StratifiedEstimator(probes_per_bin=2), solver, generator)


WORLD = SimpleNamespace(names=("a", "b"), outer=OUTER, simulator=simulator, visited={"end": PSI.flip(0)})


def test_every_way_has_an_error_and_the_default_is_the_loops_own():
    series, unrolled = Hypergradients(2, SOLVER).measure(WORLD, Timing(1), 0)
    assert [point.setting for point in series.points] == list(ways(OUTER, SOLVER))
    assert [point.setting for point in series.points if point.default] == [DEFAULT]
    assert all(0.0 <= point.error <= 2.0 and point.seconds > 0.0 for point in series.points)
    assert "two trainings correlate by" in series.note
    error = {point.setting: point.error for point in unrolled.points}
    assert unrolled.name == "hypergradient/unrolled" and all(name.startswith("unrolled") for name in error)
    assert error[EXACT] == 0.0
    # Of two steps of a new network, whose differences of gradients in float32 have few digits.
    assert error["unrolled, all probes every step"] < 0.5
    own = ways(OUTER, SOLVER)[DEFAULT].outer
    assert own.adjoint == OUTER.adjoint == Unrolled()


def test_a_derivative_that_is_the_response_has_no_error(monkeypatch):
    """The response is taken to be what one way finds, times any number and plus any constant."""
    named = ways(OUTER, SOLVER)["unrolled, exact products"]
    found = torch.randn(2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    monkeypatch.setattr(family, "response", lambda inner, psi, numbers: Response(3.0 * found + 1.0, 1))
    monkeypatch.setattr(family, "ways", lambda outer, solver: {DEFAULT: named, EXACT: named})
    monkeypatch.setattr(family, "slopes", lambda loop, way: (found, 0.5))
    series, unrolled = Hypergradients(1, SOLVER).measure(WORLD, Timing(1), 0)
    assert series.points[0].error == pytest.approx(0.0, abs=1e-12)
    assert unrolled.points[0].error == 0.0


def test_places_are_those_that_the_loop_came_to(monkeypatch):
    """A loop that a world without its first step has run; the derivative is taken at the end's psi."""
    seen = []

    def watched(loop, way):
        seen.append(loop.psi.detach().clone())
        return torch.eye(2, 4), 0.5

    monkeypatch.setattr(family, "slopes", watched)
    monkeypatch.setattr(family, "response", lambda inner, psi, numbers: Response(torch.eye(2, 4), 1))
    found = Hypergradients(1, SOLVER, places=("first_step", "end")).measure(WORLD, Timing(1), 0)
    assert [series.name for series in found] == [
        "hypergradient/of a training, end",
        "hypergradient/unrolled, end",
    ]
    assert all(torch.equal(psi, PSI.flip(0)) for psi in seen)


def test_centred_error_leaves_means_out():
    truth = torch.tensor([[3.0, -3.0], [0.0, 0.0]])
    assert centred_error(truth + 7.0, truth) == 0.0
    assert centred_error(2.0 * truth, truth) == pytest.approx(1.0)


def test_ways_see_the_same_images_probes_and_training(monkeypatch):
    loop, named, seen = simulator(OUTER, SOLVER, 0), ways(OUTER, SOLVER), []
    derivative = SimulatorModule._derivative

    def watched(self, trained, objective):
        probes, inputs = self._probes.cached.inputs[0], trained.examples.inputs[0]
        seen.append((trained.rendered.images.images, inputs, probes, flatten(trained.trainable)))
        return derivative(self, trained, objective)

    monkeypatch.setattr(SimulatorModule, "_derivative", watched)
    first, again = (slopes(loop, named[DEFAULT])[0] for _ in range(2))
    assert torch.equal(first, again)
    for way in named.values():
        slopes(loop, way)
    assert len(seen) == 2 + len(named)
    for other in seen[1:]:
        assert all(torch.equal(a, b) for a, b in zip(seen[0], other, strict=True))


def test_correlation_of_known_vectors():
    up, still = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[1.0, 1.0, 1.0]])
    assert correlation(up, -up) == pytest.approx(-1.0) and correlation(up, still) == 0.0
    assert correlation(torch.cat([up, up]), torch.cat([up, still])) == pytest.approx(0.5)


def test_bad_settings_name_their_key():
    with pytest.raises(ValueError, match=r"Hypergradients\.trainings: want at least 1"):
        Hypergradients(0)
    with pytest.raises(ValueError, match=r"Hypergradients\.places\[0\]: want one of start"):
        Hypergradients(places=("middle",))
