"""Memory by patch size: what the modes compute is the same, and only memory and time differ."""

import copy
import dataclasses
import itertools
import json

import pytest
import torch
from mlflow import MlflowClient

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.studies.frozen_loop import FrozenLoop, State
from neural_sim.studies.patch_memory import FORWARD, WHOLE, PatchCost, PatchMemory, publish

PATCHES = (64, 128, 256)


@pytest.fixture(scope="module")
def loop(scene):
    psi = torch.tensor([[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    subjects = tuple(
        dataclasses.replace(subject, field=copy.deepcopy(subject.field).double()) for subject in scene.fields
    )
    scene = dataclasses.replace(scene, subjects=subjects)
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    theta = {name: value.double() for name, value in detector.init(generator).items()}
    validation = scene.training_set(psi, 3, generator).images
    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=6), max_steps=6)
    images = scene.training_set(psi, 4, generator).images
    return FrozenLoop.at(State(scene, detector, theta, psi), images, validation, solver, generator)


@pytest.fixture(scope="module")
def rows(loop):
    return PatchMemory(PATCHES, repeats=1).measure(loop, PathwiseEstimator(mode="reverse"), seed=3)


def test_every_object_has_forward_mode_each_patch_and_the_whole_image(rows):
    methods = [FORWARD, *(f"reverse, patches of {patch}" for patch in PATCHES), WHOLE]
    assert [(row.object, row.method) for row in rows] == [(name, m) for name in ("a", "b") for m in methods]
    assert [row.patch for row in rows[:5]] == [None, *PATCHES, 32 * 32]
    assert all(row.milliseconds > 0.0 and row.cpu_milliseconds > 0.0 for row in rows)


def test_memory_grows_with_the_patch_and_the_derivative_stays(rows):
    """The paper: twice the patch, about twice the memory. A ray's samples are stored, so that memory is in proportion
    to the rays of the largest patch; patches differ in how many of their rays meet the object, hence the range."""
    for name in ("a", "b"):
        reverse = [row for row in rows if row.object == name and row.patch is not None]
        memory = [row.gradient_mb for row in reverse]
        assert memory == sorted(memory)
        assert all(1.2 < large / small < 2.5 for small, large in itertools.pairwise(memory[:3]))
        assert all(row.total_mb >= row.gradient_mb for row in reverse)
        # Sums over some 1,000 rays in another order.
        assert all(row.difference < 1e-10 for row in reverse)


@pytest.mark.parametrize("wrong", [{"patches": ()}, {"patches": (64, 0)}, {"repeats": 0}])
def test_bad_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=rf"PatchMemory\.{next(iter(wrong))}.*: want"):
        PatchMemory(**wrong)


def test_the_files_and_the_run_have_every_row(context):
    rows = [
        PatchCost("pitcher", "forward", None, 1.25, 9.5, 13.0, 26.0, 0.0),
        PatchCost("pitcher", "reverse, patches of 64", 64, 0.5, 8.0, 250.4, 251.0, 2e-6),
    ]
    run = publish(context, rows, "a field")
    text = (context.folder / "patch_memory.md").read_text()
    assert "| reverse, patches of 64 | 0.50 | 8.0 | 250 | 251 | 2e-06 |" in text and "**pitcher**" in text
    document = json.loads((context.folder / "patch_memory.json").read_text())
    assert [row["patch"] for row in document["rows"]] == [None, 64]
    logged = MlflowClient(context.uri).get_run(run.run_id).data
    assert (
        logged.metrics["pitcher/64/gradient_mb"] == 0.5 and logged.metrics["pitcher/forward/total_mb"] == 9.5
    )
