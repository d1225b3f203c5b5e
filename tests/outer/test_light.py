"""The derivative with respect to the weights of lights, through the loop's own binding, against central differences."""

import dataclasses
import math

import pytest
import torch
from small_loop import FREE

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.detector.training import Training
from neural_sim.field.appearance import AppearanceField
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.unrolled import Accumulated, Unrolled
from neural_sim.outer.derivative import bound_losses, image_losses, object_images
from neural_sim.outer.inner import InnerLoop, LoopInputs
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.probing import ProbeSet
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps
from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import HARD, SceneDistribution
from neural_sim.parameter.update import Mirror
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera

ANCHORS, DOUBLE = 3, torch.float64
DETECTOR = {"anchors": Anchors(sizes=((10,), (18,)), reference=32), "head": Head(8, 1)}


def _field(seed, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    field = AppearanceField(learned=ANCHORS, anchors=ANCHORS).eval()
    field.grid.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(0.7 * torch.randn(parameter.shape, generator=generator))
        field.grid.table[:, 0] += 1.0
    field.reset_codes(torch.eye(ANCHORS), generator)
    return field.to(dtype).requires_grad_(False)


def _scene(dtype=torch.float32, parameters=None):
    parameters = [Illumination(anchors=ANCHORS)] if parameters is None else parameters
    subjects = tuple(
        FieldSubject(name, _field(seed, dtype), NerfWRenderer()) for name, seed in (("a", 1), ("b", 2))
    )
    camera = PinholeCamera(32, 32, math.radians(40.0))
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.1)
    return Scene(subjects, camera, synthesizer, SceneDistribution.of(parameters))


def test_the_derivative_by_weights_against_central_differences():
    scene, generator, estimator = _scene(DOUBLE), torch.Generator().manual_seed(0), PathwiseEstimator()
    detector = RetinaNet(2, 32, **DETECTOR)
    params = {name: value.double() for name, value in detector.init(generator).items()}
    backbone, trainable = detector.split(params)
    vector = {name: torch.randn(v.shape, generator=generator, dtype=DOUBLE) for name, v in trainable.items()}
    psi = torch.tensor([[0.5, 0.3, 0.2], [0.1, 0.6, 0.3]], dtype=DOUBLE)
    rendered = scene.training_set(psi, 3, generator, estimator.draws)
    images = rendered.images
    losses = bound_losses(CachedSet.of(detector, backbone, images), backbone, None)
    weights = torch.full((6,), 1.0 / 6, dtype=DOUBLE)
    held = object_images(scene, rendered, psi, weights)
    targets = detector.assign(images.boxes, images.labels)

    def objective(label, light):
        """sum_i w_i <dl_i / dtheta, v> of one object's images under another light, all else replayed."""
        part = rendered.objects[label]
        draw = dataclasses.replace(part.draw, weights=light.expand(3, -1))
        maps = scene.render(label, draw)
        pixels = rendered.compose[label](maps.rgb, maps.opacity).images
        index = torch.arange(3 * label, 3 * label + 3)
        loss = image_losses(detector, backbone, targets)
        along = scores(lambda p, rows: loss(p, pixels[rows - 3 * label], rows), trainable, vector, index, 3)
        return float(along @ weights[index])

    for label, name in enumerate(scene.names):
        found = estimator.estimate(losses, trainable, vector, held[name], {}).value
        for i in range(ANCHORS):
            step = torch.zeros(ANCHORS, dtype=DOUBLE)
            step[i] = 1e-5
            slope = (objective(label, psi[label] + step) - objective(label, psi[label] - step)) / 2e-5
            assert float(found[i]) == pytest.approx(slope, rel=1e-5, abs=1e-9)


def test_probes_are_the_same_scenes_under_one_light_after_the_other():
    scene = _scene(DOUBLE, [Pose(bins=3), Illumination(anchors=ANCHORS)])
    psi = scene.distribution.psi("initial", ["a"])[0]
    images, draw = scene.probes(0, "illumination", 5, psi[None], torch.Generator().manual_seed(0))
    opacity = scene.render(0, draw).opacity
    assert torch.equal(draw.weights, torch.eye(ANCHORS, dtype=DOUBLE).repeat_interleave(5, 0))
    for values in (draw.phi, draw.bins[:, 0], opacity):
        assert torch.equal(values[:5], values[5:10]) and len(values[:5].flatten().unique()) > 1
    first, second = images.images[:5], images.images[5:10]
    # Sensor noise, shifts and backgrounds are shared, so that only the object's own pixels differ.
    differ, covered = (first != second).any(1).flatten(1).sum(1), (opacity[:5] > 0.0).flatten(1).sum(1)
    assert bool((differ > 0).all()) and bool((differ <= covered).all())
    assert bool((covered < first[0, 0].numel()).all())


def test_the_derivative_across_lights_is_that_of_a_mixture():
    """d/dw_i of sum_j w_j s_j, s_j the mean <dl/dtheta, v> of images under light j, against autograd of that sum."""
    scene, generator = _scene(DOUBLE), torch.Generator().manual_seed(0)
    detector = RetinaNet(2, 32, **DETECTOR)
    params = {name: value.double() for name, value in detector.init(generator).items()}
    backbone, trainable = detector.split(params)
    vector = {name: torch.randn(v.shape, generator=generator, dtype=DOUBLE) for name, v in trainable.items()}
    psi = torch.tensor([[0.5, 0.3, 0.2], [0.1, 0.6, 0.3]], dtype=DOUBLE)
    rendered = scene.training_set(psi, 3, generator)
    probed = ProbeSet.draw(scene, detector, backbone, 4, psi, generator, range(2))
    each = torch.arange(len(probed.cached.inputs[0]))
    exact = scores(probed.cached.losses, trainable, vector, each)
    sums = Accumulated(exact.new_zeros(0), (), exact, len(exact))
    held = object_images(scene, rendered, psi, torch.full((6,), 1.0 / 6, dtype=DOUBLE))
    for label, name in enumerate(scene.names):
        found = StratifiedEstimator(4).accumulated(sums, held[name], probed.probes[label])
        index = probed.probes[label]["illumination"].index

        def mixed(weights, index=index):
            shares = weights.repeat_interleave(4) / 4
            leaves = {key: value.detach().requires_grad_() for key, value in trainable.items()}
            loss = (probed.cached.losses(leaves, index) * shares).sum()
            slopes = torch.autograd.grad(loss, list(leaves.values()), create_graph=True)
            return sum((g * v).sum() for g, v in zip(slopes, vector.values(), strict=True))

        weights = psi[label].clone().requires_grad_()
        (slope,) = torch.autograd.grad(mixed(weights), weights)
        torch.testing.assert_close(found.value, 0.5 * (slope - slope.mean()), rtol=1e-9, atol=1e-12)
        assert bool((found.standard_error > 0.0).all())


@pytest.mark.parametrize(
    ("estimator", "adjoint"),
    [
        (StratifiedEstimator(2), Unrolled()),
        (PathwiseEstimator(), Implicit(curvature_images=4)),
        (PathwiseEstimator("reverse"), Unrolled()),
        (ReinforceEstimator(), Implicit(curvature_images=4)),
    ],
    ids=lambda value: type(value).__name__ + getattr(value, "mode", ""),
)
def test_the_loop_learns_pose_and_light_and_keeps_weights_on_their_simplex(estimator, adjoint):
    scene = _scene(parameters=[Pose(bins=3), Illumination(anchors=ANCHORS)])
    generator, start = torch.Generator().manual_seed(0), scene.distribution.psi("initial", ["a", "b"])
    detector = RetinaNet(2, 32, **DETECTOR)
    validation = scene.training_set(start.float(), 3, generator, HARD).images
    steps = FreeSteps(Mirror(shrink=False), Mirror(0.6, max_step=1.0, shrink=False))
    chosen = {"train_first": isinstance(adjoint, Unrolled), "adjoint": adjoint, "steps": steps}
    settings = Outer(2, 4, epochs=1, **FREE | chosen)
    inputs, training = (
        LoopInputs(detector, detector.init(generator), validation),
        Training(batch_size=4, weight_decay=0.0),
    )
    inner = InnerLoop.prepare(scene, inputs, settings, training, generator, estimator.draws)
    assert inner.pool is None  # a light that moves makes stored images stale
    module = SimulatorModule(inner, start, estimator, AdjointSolver(max_steps=4), generator)
    learned = learn_psi(module)
    parts = scene.distribution.split(learned.last)
    assert (parts["pose"].abs().amax(-1) > 0.0).all()
    weights = parts["illumination"]
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, dtype=DOUBLE), rtol=0.0, atol=1e-12)
    assert (weights >= 0.0).all() and ((weights - 1 / 3).abs().amax(-1) > 0.0).any()


def test_opacity_does_not_know_the_light():
    scene = _scene()
    draw = scene.distribution.hard(
        torch.ones(ANCHORS) / ANCHORS, scene.distribution.draw_noise(4, torch.Generator())
    )
    lights = [dataclasses.replace(draw, weights=light.expand(4, -1)) for light in torch.eye(ANCHORS)]
    maps = [scene.render(0, lit) for lit in lights]
    assert all(torch.equal(other.opacity, maps[0].opacity) for other in maps[1:])
    assert not torch.equal(maps[0].rgb, maps[1].rgb)


def test_explored_lights_differ_and_carry_their_density():
    scene, generator = _scene(), torch.Generator().manual_seed(0)
    psi = scene.distribution.psi("initial", ["a"])[0].float()
    part = scene.draw(0, psi, 4, generator, ReinforceEstimator().draws)
    assert part.draw.explored is not None and part.draw.weights is not None
    assert len(part.draw.weights.unique(dim=0)) == 4
    density = torch.distributions.Normal(psi, 0.1).log_prob(part.draw.explored).sum(-1)
    torch.testing.assert_close(scene.distribution.log_prob(psi, part.draw), density)
    still = scene.draw(0, psi, 2, generator)
    with pytest.raises(ValueError, match="no density"):
        scene.distribution.log_prob(psi, still.draw)
