"""The detector whose Hessian fits in memory whole, as its own configuration makes it."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.training import train_detector
from neural_sim.gradient.hypergradient import InnerProblem, SplitLoss
from neural_sim.solver.flatten import flatten, unflatten
from neural_sim.solver.gauss_newton import GaussNewtonOperator
from neural_sim.solver.hvp import HessianOperator

CONF = Path(__file__).parents[2] / "conf" / "detector" / "micro.yaml"


@pytest.fixture
def micro():
    return instantiate(OmegaConf.load(CONF))


@pytest.mark.parametrize("size", [32, 48])
def test_it_has_at_most_5000_parameters_and_learns(micro, tools, generator, size):
    detector = micro(num_classes=6, image_size=size)
    start = detector.init(generator)
    assert sum(value.numel() for value in start.values()) <= 5000
    assert sum(value.numel() for value in detector.split(start)[1].values()) <= 5000
    images = tools.images(4, dtype=torch.float32)
    if size != 32:
        return
    trained, _ = train_detector(
        detector, start, images, generator, epochs=60, batch_size=4, learning_rate=1e-2
    )
    assert tools.mean_loss(detector, trained, images) < 0.5 * tools.mean_loss(detector, start, images)


def test_curvature_of_its_loss_is_smooth_and_split_at_the_outputs(micro, tools, generator, images):
    """Hessian products agree with forward over reverse, Gauss-Newton ones with the outputs' Jacobian, in float64."""
    detector = micro(num_classes=3, image_size=32)
    backbone, trainable = detector.split(tools.noisy(detector.init(generator), generator))
    cached = CachedSet.of(detector, backbone, images)
    weights = torch.full((len(images),), 1.0 / len(images), dtype=torch.float64)
    plain = InnerProblem(trainable, cached.losses, weights, proximal=0.7, anchor=trainable)
    split = InnerProblem(
        trainable, SplitLoss(cached.outputs, cached.losses_of), weights, proximal=0.7, anchor=trainable
    )
    reference = HessianOperator(plain.terms(), trainable)
    vector = torch.randn(reference.size, generator=generator, dtype=torch.float64)
    expected = reference(vector)
    differenced = HessianOperator(split.terms(), trainable, "central_difference")(vector)
    assert (differenced - expected).norm() < 1e-6 * expected.norm()
    slope = torch.func.grad(lambda at: sum(term(unflatten(at, trainable)) for term in split.terms()))
    forward = torch.func.jvp(slope, (flatten(trainable),), (vector,))[1]
    assert (forward - expected).norm() < 1e-10 * expected.norm()

    def outputs(params):
        return torch.cat([part.flatten() for part in cached.outputs(params, torch.arange(len(images)))])

    moved = torch.func.jvp(outputs, (trainable,), (_like(vector, trainable),))[1]
    curved = torch.func.jvp(
        torch.func.grad(lambda out: _loss_of(cached, out)), (outputs(trainable),), (moved,)
    )[1]
    (pulled,) = torch.func.vjp(outputs, trainable)[1](curved)
    gauss_newton = torch.cat([part.flatten() for part in pulled.values()]) + 0.7 * vector
    torch.testing.assert_close(GaussNewtonOperator(split.terms(), trainable)(vector), gauss_newton)


def _like(vector, params):
    pieces = vector.split([value.numel() for value in params.values()])
    return {name: piece.view_as(params[name]) for name, piece in zip(params, pieces, strict=True)}


def _loss_of(cached, flat):
    images, anchors = cached.targets.labels.shape
    classes = cached.detector.num_classes
    logits, deltas = flat.split([images * anchors * classes, images * anchors * 4])
    shaped = logits.view(images, anchors, classes), deltas.view(images, anchors, 4)
    return cached.losses_of(shaped, torch.arange(images)).mean()
