"""The estimators end to end: pose parameter, grid field, renderer, composition and detector, in float64."""

from __future__ import annotations

import dataclasses

import pytest
import scipy.optimize
import torch
from torch.utils.flop_counter import FlopCounterMode

from neural_sim import cameras
from neural_sim.gradient.implicit import InnerProblem, hypergradient
from neural_sim.gradient.mixed import image_cotangents, scores
from neural_sim.gradient.pathwise import contract, draw_cotangents, map_cotangents, psi_contributions
from neural_sim.outer.derivative import rendered_path
from neural_sim.parameter.product import RelaxedDraws, SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.parameter.zoom import Zoom
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping
from neural_sim.solver.hvp import HessianOperator, gradient
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.operator import Shifted, flatten, unflatten
from neural_sim.synthesis.motion import moved_by
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.types import Maps

DOUBLE = torch.float64
COUNT = 4


def test_pathwise_equals_autograd_through_the_whole_pipeline(pipeline, pathwise):
    psi = pipeline.psi.clone().requires_grad_()
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in pipeline.trainable.items()}
    images = pipeline.compose(*pipeline.render(psi)).images
    loss = pipeline.loss_of(leaves, images, torch.arange(COUNT)).mean()
    slopes = torch.autograd.grad(loss, list(leaves.values()), create_graph=True)
    along = sum((slope * pipeline.vector[name]).sum() for slope, name in zip(slopes, leaves, strict=True))
    (reference,) = torch.autograd.grad(along, psi)
    ours = pathwise(
        pipeline.loss_of,
        pipeline.trainable,
        pipeline.vector,
        pipeline.object_images(),
        patch_size=700,
        chunk_size=3,
    )
    assert float(reference.norm()) > 0.0
    torch.testing.assert_close(ours.value, reference, rtol=1e-9, atol=1e-12)


def test_patches_and_tangents_agree_on_the_field(pipeline):
    batch = pipeline.object_images()
    cotangent = image_cotangents(
        pipeline.loss_of, pipeline.trainable, pipeline.vector, batch.images, batch.index, batch.weights
    )
    maps = map_cotangents(batch.path, cotangent)
    whole = draw_cotangents(pipeline.render_rays, batch.path.camera, batch.draw, maps, 10**6)
    patches = draw_cotangents(pipeline.render_rays, batch.path.camera, batch.draw, maps, 500)
    forward = contract(pipeline.tangents(batch.draw, ("phi", "rho", "distance")), maps)
    for name, value in whole.items():
        assert float((patches[name] - value).abs().max()) < 1e-10
        assert float((forward[name] - value).abs().max()) < 1e-8
    assert moved_by(batch.path.relaxed, pipeline.psi) == ("phi",)


def against_central_differences(scene, part, psi, generator):
    """The derivative with respect to psi of the part's maps times random cotangents."""
    maps = Maps(
        *(torch.randn(value.shape, generator=generator, dtype=DOUBLE) for value in (part.rgb, part.opacity))
    )
    path = rendered_path(scene, 0, part, lambda rgb, opacity: None)
    along = contract(part.tangents or {}, maps)
    along = along or draw_cotangents(path.render_rays, scene.camera, part.draw, maps, 500)
    found = psi_contributions(path.relaxed, psi, along).sum(0)

    def energy(psi):
        again = scene.render(0, path.relaxed(psi))
        return float((again.rgb * maps.rgb).sum() + (again.opacity * maps.opacity).sum())

    steps = 1e-6 * torch.eye(3, dtype=DOUBLE)
    expected = torch.tensor([(energy(psi + e) - energy(psi - e)) / 2e-6 for e in steps], dtype=DOUBLE)
    assert float(expected.norm()) > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_focal_length_of_every_image_against_central_differences(pipeline, mode, generator):
    """From psi through the scene's own draw, each image at a focal length of its own, to random cotangents of maps."""
    distribution = SceneDistribution.of([Zoom(bins=3, by="focal_length", range=(0.6, 1.8), temperature=0.8)])
    subject = FieldSubject("block", pipeline.field, NerfRenderer(termination=0.0))
    scene = Scene((subject,), pipeline.camera, pipeline.synthesizer, distribution)
    psi = torch.tensor([0.3, -0.2, 0.1], dtype=DOUBLE)
    part = scene.draw(0, psi, COUNT, generator, RelaxedDraws(tangents=mode == "forward"))
    assert len(part.draw.magnification.unique()) == COUNT
    against_central_differences(scene, part, psi, generator)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("by", ["distance", "focal_length"])
def test_an_off_centre_camera_and_metres_against_central_differences(pipeline, mode, by, generator):
    """From psi to random cotangents of maps; the camera is not square, off centre, of unequal focal lengths, and the
    object's radius is 0.2 m."""
    ranges = {"distance": (0.5, 0.9), "focal_length": (0.6, 1.8)}
    zoom = Zoom(bins=3, by=by, range=ranges[by], temperature=0.8, unit="metres")
    distribution = SceneDistribution.of([zoom], Unlearned(distance=(0.5, 0.7), distance_unit="metres"))
    camera = cameras.opencv_camera(36, 24, 40.0, 30.0, 14.0, 13.5)
    renderer = NerfRenderer(termination=0.0)
    subject = FieldSubject("block", pipeline.field, renderer, radius=0.2)
    scene = Scene((subject,), camera, pipeline.synthesizer, distribution)
    psi = torch.tensor([0.3, -0.2, 0.1], dtype=DOUBLE)
    part = scene.draw(0, psi, COUNT, generator, RelaxedDraws(tangents=mode == "forward"))
    draw = part.draw
    poses = cameras.orbit(draw.phi, draw.rho, draw.distance, radius=draw.radius)
    distance = poses[:, :3, 3].norm(dim=-1)
    torch.testing.assert_close(distance, part.draw.distance / 0.2)
    against_central_differences(scene, part, psi, generator)


def test_tangents_replace_the_second_render(pipeline, pathwise):
    batch = pipeline.object_images()
    tangents = pipeline.tangents(batch.draw, moved_by(batch.path.relaxed, pipeline.psi))

    def refuse(rays):
        raise AssertionError("rendered twice")

    path = dataclasses.replace(batch.path, tangents=tangents, render_rays=refuse)
    arguments = (pipeline.loss_of, pipeline.trainable, pipeline.vector)
    forward = pathwise(*arguments, dataclasses.replace(batch, path=path))
    reverse = pathwise(*arguments, batch)
    assert float((forward.value - reverse.value).abs().max()) < 1e-8


def test_scores_of_the_detector_add_up_to_the_mean_losss_slope(pipeline):
    index = torch.arange(COUNT)
    forward = scores(pipeline.losses, pipeline.trainable, pipeline.vector, index, 3, "forward")
    mean = gradient([lambda params: pipeline.losses(params, index).mean()], pipeline.trainable)
    assert float(forward.mean()) == pytest.approx(float(mean @ flatten(pipeline.vector)), rel=1e-10)


def test_hessian_products_of_the_detector_agree_and_are_cheap(pipeline):
    term = [lambda params: pipeline.losses(params, torch.arange(COUNT)).mean()]
    vector = flatten(pipeline.vector)
    with FlopCounterMode(display=False) as one_gradient:
        gradient(term, pipeline.trainable)
    products = {}
    for mode in ("reverse_over_reverse", "central_difference"):
        operator = HessianOperator(term, pipeline.trainable, mode)
        with FlopCounterMode(display=False) as cost:
            products[mode] = operator(vector)
        assert cost.get_total_flops() <= 3 * one_gradient.get_total_flops(), mode
    exact = products["reverse_over_reverse"]
    slope = torch.func.grad(lambda point: term[0](unflatten(point, pipeline.trainable)))
    forward = torch.func.jvp(slope, (flatten(pipeline.trainable),), (vector,))[1]
    torch.testing.assert_close(forward, exact, rtol=1e-9, atol=1e-10)
    assert float((products["central_difference"] - exact).norm() / exact.norm()) < 1e-5


def test_adjoint_of_the_detector_at_the_damping_that_lanczos_chose(pipeline, pathwise):
    """The whole of Eq. 2 on a detector's indefinite Hessian, against a tight solve by another method."""
    inner = InnerProblem(pipeline.trainable, pipeline.losses, torch.full((COUNT,), 1.0 / COUNT, dtype=DOUBLE))
    validation = [lambda params: pipeline.losses(params, torch.tensor([1, 3])).mean()]
    batch = pipeline.object_images()
    estimates = {"can": lambda v: pathwise(pipeline.loss_of, pipeline.trainable, v, batch)}
    solver = AdjointSolver(
        ConjugateGradient(), LanczosDamping(max_condition=20.0), rtol=1e-4, retain_graph=True
    )
    result = hypergradient(inner, validation, estimates, solver, torch.Generator().manual_seed(0))
    assert result.adjoint.solution.status is Status.CONVERGED and result.adjoint.solution.products <= 40
    assert result.adjoint.damping.spectrum.smallest < 0.0 < result.adjoint.damping.value
    operator = Shifted(
        HessianOperator(inner.terms(), pipeline.trainable, retain_graph=True), result.adjoint.damping.value
    )
    tight = MinimumResidual().solve(
        operator, gradient(validation, pipeline.trainable), rtol=1e-8, max_steps=200
    )
    assert tight.status is Status.CONVERGED
    expected = -estimates["can"](unflatten(tight.value, pipeline.trainable)).value
    error = (result.gradients["can"] - expected).norm() / expected.norm()
    assert float(error) < 1e-2


def last_layers(pipeline):
    """The predictor's last two convolutions as the inner parameters, and losses of any images under them."""
    small = {
        name: value
        for name, value in pipeline.trainable.items()
        if ".cls_logits." in name or ".bbox_reg." in name
    }

    def loss_of(params, images, index):
        return pipeline.loss_of({**pipeline.trainable, **params}, images, index)

    return small, loss_of


def test_hypergradient_of_a_detector_is_the_retrained_derivative(pipeline, pathwise):
    """Poses move the images, a proximal inner problem is retrained on them by Newton's method; sign included."""
    anchor, loss_of = last_layers(pipeline)
    proximal, every = 0.5, torch.arange(COUNT)
    weights = torch.full((COUNT,), 1.0 / COUNT, dtype=DOUBLE)
    val_images = pipeline.images.flip(-1).roll(3, -2)

    def inner_problem(params, images):
        return InnerProblem(
            params, lambda p, rows: loss_of(p, images[rows], rows), weights, 32, proximal, anchor
        )

    def minimiser(images, params):
        """L-BFGS to the neighbourhood, Newton to stationarity."""
        terms = inner_problem(params, images).terms()

        def value_and_slope(flat):
            point = unflatten(torch.from_numpy(flat), params)
            return float(sum(term(point) for term in terms)), gradient(terms, point).numpy()

        start = flatten(params).numpy()
        found = scipy.optimize.minimize(
            value_and_slope, start, jac=True, method="L-BFGS-B", options={"maxiter": 500, "gtol": 1e-5}
        )
        params = unflatten(torch.from_numpy(found.x), params)
        for _ in range(6):
            slope = gradient(terms, params)
            if float(slope.norm()) < 1e-11:
                break
            hessian = HessianOperator(terms, params, retain_graph=True)
            step = ConjugateGradient().solve(hessian, slope, rtol=1e-5, max_steps=200)
            params = unflatten(flatten(params) - step.value, params)
        return params

    def validation(params):
        return loss_of(params, val_images, every).mean()

    batch = pipeline.object_images()
    params = minimiser(batch.images, anchor)
    estimates = {"can": lambda v: pathwise(loss_of, params, v, batch)}
    solver = AdjointSolver(
        ConjugateGradient(), FixedDamping(0.0, 0), rtol=1e-10, max_steps=300, retain_graph=True
    )
    result = hypergradient(
        inner_problem(params, batch.images), [validation], estimates, solver, torch.Generator().manual_seed(0)
    )
    assert result.adjoint.solution.status is Status.CONVERGED and result.adjoint.stationarity < 1e-10
    slopes = []
    for direction in 1e-4 * torch.eye(4, dtype=DOUBLE):
        ends = []
        for psi in (pipeline.psi + direction, pipeline.psi - direction):
            with torch.no_grad():
                images = pipeline.compose(*pipeline.render(psi)).images
            ends.append(validation(minimiser(images, params)))
        slopes.append(float(ends[0] - ends[1]) / 2e-4)
    reference = torch.tensor(slopes, dtype=DOUBLE)
    error = float((result.gradients["can"] - reference).norm() / reference.norm())
    assert error < 1e-5
