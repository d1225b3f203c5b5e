"""First and second derivatives of the loss, in float64, in every mode that the solvers and gradients use."""

import pytest
import torch
from torch.func import grad, jvp, vjp

COARSER = {
    "anchors": {"strides": (8, 16, 32, 64), "sizes": ((8, 12), (16, 24), (32, 40), (64, 80))},
    "head": {"normalisation": "none"},
}


@pytest.fixture(params=[{}, COARSER], ids=["two levels", "coarser levels"])
def problem(request, tools, generator, images):
    return make_problem(tools, generator, images, **request.param)


def make_problem(tools, generator, images, **changes):
    detector = tools.detector(**changes)
    params = tools.noisy(detector.init(generator), generator)
    backbone, trainable = detector.split(params)
    targets = detector.assign(images.boxes, images.labels)
    features = detector.features(backbone, images.images)
    return detector, backbone, trainable, features, targets


def direction(params, seed):
    generator = torch.Generator().manual_seed(seed)
    return {k: torch.randn(v.shape, generator=generator, dtype=v.dtype) for k, v in params.items()}


def dot(a, b):
    return sum((a[name] * b[name]).sum() for name in a)


def shifted(params, step, v):
    return {name: params[name] + step * v[name] for name in params}


def test_per_image_derivative_is_the_central_difference(problem):
    detector, _, trainable, features, targets = problem
    v = direction(trainable, 1)
    _, tangent = jvp(lambda p: detector.per_image_loss(p, features, targets), (trainable,), (v,))
    step = 1e-6
    plus = detector.per_image_loss(shifted(trainable, step, v), features, targets)
    minus = detector.per_image_loss(shifted(trainable, -step, v), features, targets)
    torch.testing.assert_close(tangent, (plus - minus) / (2 * step), rtol=1e-6, atol=1e-7)


def test_forward_and_reverse_mode_agree(problem):
    detector, _, trainable, features, targets = problem
    v = direction(trainable, 1)
    losses, pull = vjp(lambda p: detector.per_image_loss(p, features, targets), trainable)
    weights = torch.linspace(1, 2, len(losses), dtype=torch.float64)
    (gradient,) = pull(weights)
    _, tangent = jvp(lambda p: detector.per_image_loss(p, features, targets), (trainable,), (v,))
    torch.testing.assert_close(dot(gradient, v), (weights * tangent).sum(), rtol=1e-10, atol=0)


def test_hessian_is_symmetric_and_the_same_in_both_modes(problem):
    check_modes(problem)


def test_both_modes_pass_relu_and_l1(tools, generator, images):
    check_modes(make_problem(tools, generator, images, **COARSER, activation="relu", losses={"box": "l1"}))


def check_modes(problem):
    detector, _, trainable, features, targets = problem
    gradient = grad(lambda p: detector.per_image_loss(p, features, targets).mean())
    u, v = direction(trainable, 2), direction(trainable, 3)
    _, forward_v = jvp(gradient, (trainable,), (v,))
    _, forward_u = jvp(gradient, (trainable,), (u,))
    torch.testing.assert_close(dot(u, forward_v), dot(v, forward_u), rtol=1e-9, atol=0)
    leaves = {name: value.clone().requires_grad_() for name, value in trainable.items()}
    first = torch.autograd.grad(
        detector.per_image_loss(leaves, features, targets).mean(), list(leaves.values()), create_graph=True
    )
    product = sum((g * v[name]).sum() for g, name in zip(first, leaves, strict=True))
    second = torch.autograd.grad(product, list(leaves.values()))
    for reverse, name in zip(second, leaves, strict=True):
        torch.testing.assert_close(reverse, forward_v[name], rtol=1e-8, atol=1e-10)


def test_hessian_is_the_central_difference_of_gradients(problem):
    detector, _, trainable, features, targets = problem
    gradient = grad(lambda p: detector.per_image_loss(p, features, targets).mean())
    v = direction(trainable, 4)
    _, product = jvp(gradient, (trainable,), (v,))
    step = 1e-6
    plus, minus = gradient(shifted(trainable, step, v)), gradient(shifted(trainable, -step, v))
    difference = {name: (plus[name] - minus[name]) / (2 * step) for name in plus}
    error = shifted(difference, -1, product)
    assert dot(error, error).sqrt() < 1e-6 * dot(product, product).sqrt()


def test_mixed_derivative_in_the_images(problem, images):
    """Tool 2's cotangent: d/dx of <dL/dtheta, v>, against a central difference along one image direction."""
    detector, backbone, trainable, _, targets = problem
    v = direction(trainable, 5)

    def slope(x):
        features = detector.features(backbone, x)
        return jvp(lambda p: detector.per_image_loss(p, features, targets).mean(), (trainable,), (v,))[1]

    cotangent = grad(slope)(images.images)
    along = torch.randn(images.images.shape, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    step = 1e-6
    difference = (slope(images.images + step * along) - slope(images.images - step * along)) / (2 * step)
    torch.testing.assert_close((cotangent * along).sum(), difference, rtol=1e-5, atol=1e-8)
