"""Which detections count as right, and what a picture shows."""

import base64
import io

import numpy as np
import torch
from PIL import Image, ImageColor

from neural_sim.report.figures import CLASS_COLOURS
from neural_sim.report.page import pictures
from neural_sim.types import LabelledImages

A, B = torch.tensor([2.0, 2.0, 10.0, 10.0]), torch.tensor([12.0, 2.0, 20.0, 10.0])


def found(*rows):
    boxes = torch.stack([box for box, _, _ in rows]) if rows else torch.zeros(0, 4)
    labels = torch.tensor([label for _, label, _ in rows]).long()
    return {"boxes": boxes, "labels": labels, "scores": torch.tensor([score for *_, score in rows])}


def truth(*rows):
    return torch.stack([box for box, _ in rows]), torch.tensor([label for _, label in rows])


def test_right_is_the_right_class_in_the_right_place_among_the_best():
    assert pictures.right(found((A, 0, 0.9), (B, 1, 0.2)), *truth((A, 0)))
    assert not pictures.right(found((A, 1, 0.9), (A, 0, 0.8)), *truth((A, 0)))  # the best is another class
    assert not pictures.right(found((B, 0, 0.9)), *truth((A, 0)))  # another place
    assert not pictures.right(found(), *truth((A, 0)))


def test_a_class_alone_is_right_where_accuracy_is_the_score():
    assert pictures.right(found((B, 0, 0.9)), *truth((A, 0)), "accuracy")
    assert not pictures.right(found((A, 1, 0.9)), *truth((A, 0)), "accuracy")


def test_every_object_wants_a_detection_of_its_own():
    both = truth((A, 0), (A + 1.0, 0))
    assert not pictures.right(found((A, 0, 0.9), (B, 0, 0.8)), *both)  # one detection overlaps both objects
    assert pictures.right(found((A, 0, 0.9), (A + 1.0, 0, 0.8)), *both)
    assert pictures.right(found((A + 1.0, 0, 0.9), (A, 0, 0.8)), *both)


def test_an_empty_image_is_right_when_nothing_is_seen():
    empty = torch.zeros(0, 4), torch.zeros(0).long()
    assert pictures.right(found((A, 0, 0.2)), *empty) and not pictures.right(found((A, 0, 0.4)), *empty)


def test_a_picture_has_its_boxes_in_the_colour_of_the_class():
    images = LabelledImages(
        torch.full((1, 3, 24, 24), 0.5),
        torch.stack([A, B])[None],
        torch.tensor([[1, -1]]),
        torch.zeros(1).long(),
    )
    (picture,) = pictures.labelled(images, [0], ["can", "mug"])
    assert picture.caption == "mug"
    kind, data = picture.source.split(",")
    drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)
    assert kind == "data:image/jpeg;base64" and drawn.shape == (192, 192, 3)
    wanted = np.asarray(ImageColor.getrgb(CLASS_COLOURS[1]))
    assert np.abs(drawn[17:80, 17] - wanted).max(-1).mean() < 60  # the left edge of A at 8 times its size
    assert np.abs(drawn[40, 100:110] - 127).max() < 12  # B is padding and is not drawn


def test_the_best_detections_are_drawn_over_the_truth():
    images = LabelledImages(
        torch.full((1, 3, 24, 24), 0.5), A[None, None], torch.tensor([[0]]), torch.zeros(1).long()
    )
    (picture,) = pictures.detected(images, [0], [found((B, 1, 0.61), (A, 0, 0.3))], ["can", "mug"])
    assert picture.caption == "mug 0.61"
    (nothing,) = pictures.detected(images, [0], [found()], ["can", "mug"])
    assert nothing.caption == "nothing"
