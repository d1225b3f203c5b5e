"""The detector whose Hessian fits in memory whole, as its own configuration makes it."""

import pytest
import torch

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.module import Optimisation
from neural_sim.detector.training import train_detector
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.solver.hvp import HessianOperator
from neural_sim.solver.operator import flatten, unflatten


@pytest.fixture
def micro(tools):
    return tools.configured("micro")


@pytest.mark.parametrize("size", [32, 48])
def test_it_has_at_most_5000_parameters_and_learns(micro, tools, generator, size):
    detector = micro(num_classes=6, image_size=size)
    start = detector.init(generator)
    assert sum(value.numel() for value in start.values()) <= 5000
    assert sum(value.numel() for value in detector.split(start)[1].values()) <= 5000
    images = tools.images(4, dtype=torch.float32)
    if size != 32:
        return
    how = Optimisation(60, batch_size=4, learning_rate=1e-2, weight_decay=1e-2)
    trained, _ = train_detector(detector, start, images, generator, how)
    assert tools.mean_loss(detector, trained, images) < 0.5 * tools.mean_loss(detector, start, images)


def test_products_with_the_hessian_of_its_loss_agree(micro, tools, generator, images):
    """Both modes with forward over reverse, in float64."""
    detector = micro(num_classes=3, image_size=32)
    backbone, trainable = detector.split(tools.noisy(detector.init(generator), generator))
    cached = CachedSet.of(detector, backbone, images)
    weights = torch.full((len(images),), 1.0 / len(images), dtype=torch.float64)
    terms = InnerProblem(trainable, cached.losses, weights, proximal=0.7, anchor=trainable).terms()
    operator = HessianOperator(terms, trainable)
    vector = torch.randn(operator.size, generator=generator, dtype=torch.float64)
    slope = torch.func.grad(lambda at: sum(term(unflatten(at, trainable)) for term in terms))
    expected = torch.func.jvp(slope, (flatten(trainable),), (vector,))[1]
    assert (operator(vector) - expected).norm() < 1e-10 * expected.norm()
    differenced = HessianOperator(terms, trainable, "central_difference")(vector)
    assert (differenced - expected).norm() < 1e-6 * expected.norm()
