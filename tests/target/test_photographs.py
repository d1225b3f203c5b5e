"""Photographs from files: what is refused, how they are letterboxed, which of their boxes are kept."""

import logging

import numpy as np
import pytest
import torch
from PIL import Image

from neural_sim.target.photographs import Photograph, read


def test_boxes_follow_their_photograph_and_small_ones_are_counted(tmp_path, caplog):
    """Of 40 x 20 pixels in 20 x 20: halved, in rows 5 to 15. A box without a size is the whole photograph."""
    Image.new("RGB", (40, 20), "white").save(tmp_path / "a.png")
    boxes = torch.tensor([[4.0, 2.0, 24.0, 12.0], [4.0, 2.0, 5.0, 12.0], [30.0, 10.0, 60.0, 15.0]])
    boxed = Photograph(tmp_path / "a.png", torch.tensor([1, 0, 2]), boxes, torch.tensor([3, 4, -1]))
    whole = Photograph(tmp_path / "a.png", torch.tensor([0]))
    with caplog.at_level(logging.WARNING):
        images, placings = read([boxed, whole], 20, 20, 2.0, "here")
    assert images.boxes.tolist() == [[[2, 6, 12, 11], [15, 10, 20, 12.5]], [[0, 5, 20, 15], [0, 0, 0, 0]]]
    assert images.labels.tolist() == [[1, 2], [0, -1]] and images.bins.tolist() == [[3, -1], [-1, -1]]
    assert "here: 1 boxes with a side below 2 px or outside their photographs are dropped" in caplog.text
    assert all(
        placing.inside(image).eq(1.0).all() for placing, image in zip(placings, images.images, strict=True)
    )
    assert placings[0].inside(images.images[0]).shape == (3, 10, 20)
    assert read([whole], 20, 20, 30.0, "here")[0].bins.tolist() == [-1]
    with pytest.raises(ValueError, match="want at least one photograph, got none"):
        read([], 20, 20, 2.0, "here")


def test_a_border_is_cut_off_before_boxes_are_placed(tmp_path):
    pixels = np.zeros((12, 12, 3), np.uint8)
    pixels[2:-2, 2:-2] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image, placing = Photograph(tmp_path / "a.png", torch.tensor([0]), border=2).letterboxed(8, 8)
    assert bool(image.eq(1.0).all()) and (placing.width, placing.height) == (8, 8)
    with pytest.raises(
        ValueError, match=r"target\.border: 6 leaves nothing of .*a\.png, which has 12 x 12 pixels"
    ):
        Photograph(tmp_path / "a.png", torch.tensor([0]), border=6).letterboxed(8, 8)
