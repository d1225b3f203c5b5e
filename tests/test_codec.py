"""Stored views and images come back up to their 8 bits."""

import torch

from neural_sim import codec
from neural_sim.types import LabelledImages, PinholeCamera, PosedViews


def test_views_round_trip():
    views = PosedViews(torch.rand(2, 5, 4, 4), torch.eye(4).repeat(2, 1, 1), PinholeCamera(4, 5, 0.7))
    back = codec.unpack_views(codec.pack_views(views))
    assert back.light_weights is None
    lit = PosedViews(
        views.images, views.camera_to_world, views.camera, torch.tensor([[0.3, 0.7], [1.0, 0.0]])
    )
    weights = codec.unpack_views(codec.pack_views(lit)).light_weights
    assert weights is not None and torch.equal(weights, torch.tensor([[0.3, 0.7], [1.0, 0.0]]))
    assert back.camera == views.camera and torch.equal(back.camera_to_world, views.camera_to_world)
    assert (back.images - views.images).abs().max() <= 0.5 / 255 + 1e-6


def test_images_round_trip():
    labels = torch.tensor([[0], [-1]])
    images = LabelledImages(torch.rand(2, 3, 6, 6), torch.rand(2, 1, 4), labels, torch.tensor([1, -1]))
    back = codec.unpack_images(codec.pack_images(images))
    assert torch.equal(back.labels, labels) and torch.equal(back.boxes, images.boxes)
    assert (back.images - images.images).abs().max() <= 0.5 / 255 + 1e-6
