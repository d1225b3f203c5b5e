"""Probes are renewed place by place: what is not renewed keeps its image, its bin and its row."""

import dataclasses
import itertools
import math

import pytest
import torch
from small_loop import FREE

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.losses import Targets
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.detector.training import Training
from neural_sim.field.grid import GridField
from neural_sim.gradient.base import Probes
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.probing import ProbeSet
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import Mirror
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera

BINS, OBJECTS, FACTORS = 3, 2, ("pose", "zoom")


def _probes(per_bin: int, mark: int) -> ProbeSet:
    """Features that name their own row (mark + row), so that any mix shows where each came from."""
    count = BINS * per_bin
    rows = torch.arange(OBJECTS * len(FACTORS) * count)
    named = [
        {
            name: Probes(
                torch.arange(count) + (label * len(FACTORS) + column) * count,
                torch.arange(BINS).repeat_interleave(per_bin),
            )
            for column, name in enumerate(FACTORS)
        }
        for label in range(OBJECTS)
    ]
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    targets = Targets((mark + rows)[:, None], (mark + rows).float()[:, None, None].expand(-1, 1, 4))
    return ProbeSet(named, CachedSet(detector, ((mark + rows).float()[:, None],), targets), per_bin)


def test_the_places_whose_turn_it_is_are_renewed_and_no_others():
    held, fresh = _probes(4, 0), _probes(1, 1000)
    held = dataclasses.replace(held, turn=2)
    mixed = held.renewed(fresh)
    features = mixed.cached.features[0][:, 0]
    assert torch.equal(mixed.cached.targets.labels[:, 0].float(), features)
    assert torch.equal(mixed.cached.targets.deltas[:, 0, 0], features)
    for label in range(OBJECTS):
        for name in FACTORS:
            before, after = held.probes[label][name], mixed.probes[label][name]
            assert torch.equal(before.index, after.index) and torch.equal(before.bins, after.bins)
            found = features[after.index].view(BINS, 4)
            kept = before.index.view(BINS, 4).float()
            assert torch.equal(found[:, [0, 1, 3]], kept[:, [0, 1, 3]])
            assert torch.equal(found[:, 2], 1000.0 + fresh.probes[label][name].index.float())
    assert torch.equal(
        held.cached.features[0][:, 0], torch.arange(len(features)).float()
    )  # the old set stays


@pytest.mark.parametrize(("per_bin", "part"), [(4, 2), (4, 3), (5, 2), (3, 1)])
def test_every_place_is_renewed_in_turn(per_bin, part):
    held = _probes(per_bin, 0)
    turns = -(-per_bin // part)
    for turn in range(turns):
        held = held.renewed(_probes(part, 1000 * (turn + 1)))
    assert bool((held.cached.features[0] >= 1000).all())


def test_more_fresh_probes_than_places_are_refused():
    with pytest.raises(ValueError, match="at most 2 fresh ones per bin, got 3"):
        _probes(2, 0).renewed(_probes(3, 0))


@pytest.fixture(scope="module")
def scene():
    field = GridField().eval()
    field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
    distribution = SceneDistribution.of([Pose(bins=4)])
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    camera = PinholeCamera(32, 32, math.radians(40.0))
    subject = FieldSubject("a", field.requires_grad_(False), NerfRenderer())
    return Scene((subject,), camera, synthesizer, distribution)


def test_the_loop_draws_a_part_of_its_probes_anew(scene):
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(1, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    validation = scene.training_set(torch.zeros(1, 4), 2, generator).images
    adjoint = {"adjoint": Implicit(curvature_images=2)}
    settings = Outer(
        images_per_object=2, epochs=0, refresh=0.5, pool_per_bin=2, learned=scene.names, **FREE | adjoint
    )
    inputs, training = (
        LoopInputs(detector, detector.init(generator), validation),
        Training(batch_size=2, weight_decay=0.0),
    )
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator)
    estimator, solver = StratifiedEstimator(probes_per_bin=4), AdjointSolver(max_steps=2)
    module = SimulatorModule(inner, torch.zeros(1, 4), estimator, solver, generator)
    drawn = []
    for step in range(3):
        module.training_step(step, step)
        assert module._probes is not None
        drawn.append(module._probes.cached.features[0].flatten(1))
    kept = [(before == after).all(1).view(-1, 4).tolist() for before, after in itertools.pairwise(drawn)]
    assert kept == [[[False, False, True, True]] * 4, [[True, True, False, False]] * 4]


def test_objects_whose_psi_is_fixed_get_no_probes_and_do_not_move(scene):
    two = dataclasses.replace(
        scene, subjects=tuple(dataclasses.replace(scene.fields[0], name=name) for name in "ab")
    )
    generator, psi = torch.Generator().manual_seed(0), torch.zeros(2, 4)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    validation = two.training_set(psi, 2, generator).images
    chosen = {"adjoint": Implicit(curvature_images=2), "steps": FreeSteps(Mirror(shrink=False))}
    settings = Outer(2, 2, epochs=1, pool_per_bin=2, learned=("b",), **FREE | chosen)
    inputs, training = (
        LoopInputs(detector, detector.init(generator), validation),
        Training(batch_size=2, weight_decay=0.0),
    )
    inner = InnerLoop.prepare(two, inputs, settings, training, generator)
    estimator, solver = StratifiedEstimator(probes_per_bin=2), AdjointSolver(max_steps=2)
    module = SimulatorModule(inner, psi, estimator, solver, generator)
    learned = learn_psi(module)
    assert module._probes is not None and not module._probes.probes[0] and module._probes.probes[1]
    assert not learned.last[0].any() and learned.last[1].any()
    assert [record.images for record in learned.records] == [4 + 8, 4 + 4]
    first = learned.records[0]
    assert first.gradient_norms[0] == first.gradient_errors[0] == 0.0
    assert first.gradient_norms[1] > 0.0 and first.gradient_errors[1] > 0.0


@pytest.mark.parametrize("refresh", [0.0, 1.5, math.nan])
def test_a_part_outside_its_range_is_refused(refresh):
    with pytest.raises(ValueError, match=r"Outer\.refresh"):
        Outer(refresh=refresh)
