"""Every estimator is measured at every number of images; averages over more images are averages of fewer."""

import math
from types import SimpleNamespace

import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.damping import LanczosDamping
from neural_sim.studies.frozen_loop import FrozenLoop, State
from neural_sim.studies.work_precision.estimator import Estimators, ceilings, cosine, relative_error
from neural_sim.studies.work_precision.measurement import Timing
from neural_sim.studies.work_precision.solver import PSI, small_scene


@pytest.fixture(scope="module")
def world():
    generator, scene = torch.Generator().manual_seed(0), small_scene()
    detector = RetinaNet(2, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))
    theta, images = detector.init(generator), scene.training_set(PSI, 4, generator).images
    solver = AdjointSolver(damping=LanczosDamping(lanczos_steps=6), max_steps=6)
    loop = FrozenLoop.at(State(scene, detector, theta, PSI), images, images, solver, generator)
    return SimpleNamespace(loop=loop, names=scene.names)


def test_every_estimator_has_a_point_for_every_number_of_images(world):
    family = Estimators((4, 8), default=16, repeats=1, truth_per_bin=6, pathwise=("circular",))
    error, cosines = family.measure(world, Timing(1), 0)
    assert [error.name, cosines.name] == ["estimator/relative error", "estimator/1 - cosine"]
    counts = {}
    for point in error.points:
        counts.setdefault(point.line, []).append(int(point.setting.split()[-2]))
    # Strata want two images of each of four bins, for the noise; the default is measured beside the others.
    assert counts == {
        "pathwise, circular": [4, 8], "stratified": [8, 16], "stratified, shrunk": [8, 16], "reinforce": [4, 8]
    }  # fmt: skip
    assert [point.setting for point in error.points if point.default] == ["stratified, 16 images"]
    assert all(math.isfinite(p.error) and p.seconds > 0.0 for p in (*error.points, *cosines.points))
    assert all(0.0 <= p.error <= 2.0 for p in cosines.points)


@pytest.mark.slow
def test_the_stratified_estimate_comes_near_the_reference_with_more_images(world):
    family = Estimators((8, 256), default=256, repeats=2, truth_per_bin=128, pathwise=())
    error = {p.setting: p.error for p in next(iter(family.measure(world, Timing(1), 0))).points}
    # 32 times the images: a noise 5.7 times smaller, plus the reference's own.
    assert error["stratified, 256 images"] < 0.5 * error["stratified, 8 images"]


def test_cosine_error_and_ceiling_of_known_vectors():
    a, b = torch.tensor([[3.0, 4.0], [0.0, 0.0]]), torch.tensor([[3.0, -4.0], [1.0, 0.0]])
    torch.testing.assert_close(cosine(a, b), torch.tensor([(9.0 - 16.0) / 25.0, 0.0]))
    torch.testing.assert_close(relative_error(a, b), torch.tensor([8.0 / 5.0, 1.0]))
    # |g|^2 = 25, of which 9 is noise: sqrt(16 / 25).
    assert ceilings(a[:1], torch.tensor([[3.0, 0.0]])) == pytest.approx([0.8])
    assert ceilings(a[:1], torch.tensor([[6.0, 0.0]])) == [0.0]


def test_bad_settings_name_their_key():
    for wrong, key in (({"images": (16, 24)}, "images"), ({"pathwise": ("quantum",)}, "pathwise"),
                       ({"truth_per_bin": 1}, "truth_per_bin")):  # fmt: skip
        with pytest.raises(ValueError, match=rf"stimators?\.{key}"):
            Estimators(**wrong)
