"""Scores and image cotangents against plain autograd, image by image."""

from __future__ import annotations

import pytest
import torch

from neural_sim.gradient.mixed import image_cotangents, scores

DOUBLE = torch.float64


@pytest.fixture
def setting(generator):
    def draw(*shape: int):
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    params = {"conv": draw(4, 3, 3, 3), "scale": draw(4), "unused": draw(2)}
    vector = {name: draw(*tensor.shape) for name, tensor in params.items()}
    images, targets, weights = draw(5, 3, 4, 4), draw(5), draw(5)

    def loss_of(p, x, index):
        hidden = torch.nn.functional.silu(torch.nn.functional.conv2d(x, p["conv"], padding=1)).mean((2, 3))
        return (hidden @ p["scale"] - targets[index]).square() + 0.0 * p["unused"].sum()

    return loss_of, params, vector, images, weights


def single_scores(loss_of, params, vector, images):
    found = []
    for row in range(len(images)):
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in params.items()}
        loss = loss_of(leaves, images[row : row + 1], torch.tensor([row])).sum()
        slopes = torch.autograd.grad(loss, list(leaves.values()), create_graph=True)
        found.append(sum((slope * vector[name]).sum() for slope, name in zip(slopes, leaves, strict=True)))
    return torch.stack(found)


@pytest.mark.parametrize("chunk_size", [1, 2, 100])
def test_scores_equal_single_gradients(setting, chunk_size):
    loss_of, params, vector, images, _ = setting
    index = torch.tensor([3, 0, 4, 1])
    ours = scores(lambda p, rows: loss_of(p, images[rows], rows), params, vector, index, chunk_size)
    torch.testing.assert_close(ours, single_scores(loss_of, params, vector, images)[index])
    assert not ours.requires_grad


@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_differenced_scores_are_within_their_order_whatever_the_vectors_size(setting, size):
    """eps^(2/3) is 4e-11 in float64; third derivatives and the size of the losses here leave 1e-8 of it."""
    loss_of, params, vector, images, _ = setting
    vector = {name: size * part for name, part in vector.items()}

    def found(mode, along=vector):
        return scores(lambda p, rows: loss_of(p, images[rows], rows), params, along, torch.arange(5), 2, mode)

    torch.testing.assert_close(
        found("central_difference"),
        found("forward"),
        rtol=1e-8,
        atol=1e-8 * float(found("forward").abs().max()),
    )
    nothing = {name: 0.0 * part for name, part in vector.items()}
    assert torch.equal(found("central_difference", nothing), torch.zeros(5, dtype=DOUBLE))


@pytest.mark.parametrize("chunk_size", [1, 2, 100])
def test_an_images_cotangent_equals_autograd(setting, chunk_size):
    loss_of, params, vector, images, weights = setting
    leaf = images.clone().requires_grad_()
    (reference,) = torch.autograd.grad(single_scores(loss_of, params, vector, leaf) @ weights, leaf)
    ours = image_cotangents(loss_of, params, vector, images, torch.arange(5), weights, chunk_size)
    torch.testing.assert_close(ours, reference)


def test_an_images_cotangent_equals_a_central_difference(setting, generator):
    loss_of, params, vector, images, weights = setting
    direction = torch.randn(images.shape, generator=generator, dtype=DOUBLE)

    def total(x):
        return float(
            scores(lambda p, rows: loss_of(p, x[rows], rows), params, vector, torch.arange(5)) @ weights
        )

    difference = (total(images + 1e-5 * direction) - total(images - 1e-5 * direction)) / 2e-5
    ours = image_cotangents(loss_of, params, vector, images, torch.arange(5), weights)
    assert float((ours * direction).sum()) == pytest.approx(difference, rel=1e-7)


def test_no_images_no_scores(setting):
    loss_of, params, vector, images, _ = setting
    empty = torch.zeros(0, dtype=torch.long)
    assert scores(lambda p, rows: loss_of(p, images[rows], rows), params, vector, empty).shape == (0,)
    nothing = image_cotangents(loss_of, params, vector, images[:0], empty, torch.zeros(0))
    assert nothing.shape == (0, 3, 4, 4)


def test_unknown_modes_are_refused(setting):
    loss_of, params, vector, images, weights = setting
    with pytest.raises(ValueError, match="mode"):
        scores(lambda p, rows: loss_of(p, images[rows], rows), params, vector, torch.arange(5), 2, "reverse")
    with pytest.raises(ValueError, match="chunk_size"):
        image_cotangents(loss_of, params, vector, images, torch.arange(5), weights, 0)
