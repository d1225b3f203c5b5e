import pytest
import torch

from neural_sim.synthesis.boxes import boxes_from_opacity

DOUBLE = torch.float64


def test_box_of_a_rectangle() -> None:
    opacity = torch.zeros(1, 10, 12, dtype=torch.float64)
    opacity[0, 2:7, 3:11] = 1.0
    boxes, present = boxes_from_opacity(opacity)
    assert boxes.tolist() == [[[3.0, 2.0, 11.0, 7.0]]]
    assert present.tolist() == [True]
    assert boxes.dtype == torch.float64


def test_single_pixels_in_the_corners_give_unit_boxes() -> None:
    opacity = torch.zeros(2, 6, 9)
    opacity[0, 0, 0] = opacity[1, 5, 8] = 0.6
    boxes, present = boxes_from_opacity(opacity)
    assert boxes[:, 0].tolist() == [[0, 0, 1, 1], [8, 5, 9, 6]]
    assert present.all()


def test_parts_of_an_object_share_one_box() -> None:
    opacity = torch.zeros(1, 6, 6)
    opacity[0, 1, 4] = opacity[0, 4, 1] = 1.0
    assert boxes_from_opacity(opacity)[0].tolist() == [[[1, 1, 5, 5]]]


def test_boxes_of_discs_follow_their_centre_and_radius() -> None:
    """Closed form: a disc of radius r about c covers c - r to c + r, here within a pixel."""
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    for cx, cy, radius in ((20.3, 31.1, 7.6), (40.0, 22.5, 15.2)):
        distance = ((x - cx) ** 2 + (y - cy) ** 2).sqrt()
        boxes, _ = boxes_from_opacity(torch.sigmoid((radius - distance) * 3.0)[None])
        want = torch.tensor([cx - radius, cy - radius, cx + radius, cy + radius])
        assert (boxes[0, 0] - want).abs().max() < 1.0


def test_threshold_is_exclusive_and_area_inclusive() -> None:
    opacity = torch.full((1, 3, 3), 0.5)
    assert not boxes_from_opacity(opacity, threshold=0.5)[1].any()
    assert boxes_from_opacity(opacity, threshold=0.49, minimum_area=9)[1].all()
    boxes, present = boxes_from_opacity(opacity, threshold=0.49, minimum_area=10)
    assert not present.any()
    assert not boxes.any()


def test_nothing_visible_gives_no_box_whatever_the_minimum() -> None:
    boxes, present = boxes_from_opacity(torch.zeros(2, 4, 4), minimum_area=0.0)
    assert not present.any()
    assert not boxes.any()


def test_opacity_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\[n, h, w\], got shape \(1, 1, 4, 4\)"):
        boxes_from_opacity(torch.zeros(1, 1, 4, 4))
