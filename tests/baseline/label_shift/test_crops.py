"""Which boxes show one view of an object, in images of random colours."""

from dataclasses import replace

import pytest
import torch
from painted_pools import SIDE, moved

from neural_sim.baseline.label_shift import crops
from neural_sim.baseline.label_shift.crops import views_of
from neural_sim.types import LabelledImages


@pytest.fixture
def images():
    """Twelve different images, each with a box of class 0 or 1 at the same place."""
    generator = torch.Generator().manual_seed(0)
    cells = torch.rand(12, 3, SIDE // 2, SIDE // 2, generator=generator)
    pixels = cells.repeat_interleave(2, -1).repeat_interleave(2, -2)
    boxes = torch.tensor([12.0, 10.0, 34.0, 36.0]).expand(12, 1, 4).clone()
    labels = torch.arange(12)[:, None] % 2
    return LabelledImages(pixels, boxes, labels, torch.full_like(labels, -1))


def test_views_are_of_one_object_at_one_place_in_images_that_look_alike(images):
    three = images.select(torch.arange(3))
    twice = LabelledImages.concatenate([three, three])
    assert views_of(twice, False).tolist() == [0, 1, 2, 0, 1, 2]
    elsewhere = replace(twice, boxes=twice.boxes.clone())
    elsewhere.boxes[3] += SIDE / 2
    assert views_of(elsewhere, False).tolist() == [0, 1, 2, 3, 1, 2]
    assert views_of(elsewhere, True).tolist() == [0, 1, 2, 0, 1, 2]
    other = replace(twice, labels=twice.labels.clone())
    other.labels[4] = 1 - other.labels[4]
    assert views_of(other, False).tolist() == [0, 1, 2, 0, 4, 2]


def test_the_bars_of_letterboxed_images_do_not_make_them_look_alike(images):
    barred = replace(images, images=images.images.clone())
    barred.images[:, :, :14] = 0.5
    barred.images[:, :, -14:] = 0.5
    assert views_of(barred, True).tolist() == [*range(12)]


def test_views_do_not_depend_on_how_many_boxes_are_compared_at_once(images, monkeypatch):
    video = LabelledImages.concatenate([images, moved(images, 1), moved(images, -1)])
    at_once = [views_of(video, whole).tolist() for whole in (False, True)]
    assert at_once == [[*range(12)] * 3] * 2
    monkeypatch.setattr(crops, "_COMPARED", 5)
    assert [views_of(video, whole).tolist() for whole in (False, True)] == at_once
