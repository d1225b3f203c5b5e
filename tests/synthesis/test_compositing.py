"""Composition, shifts, layers and boxes against closed forms."""

import pytest
import torch

from neural_sim.synthesis.compositing import (
    apply_shift,
    boxes_from_opacity,
    by_depth,
    composite,
    draw_shift,
    stacked,
    visible_boxes,
)


def test_composite_of_hand_made_pixels() -> None:
    rgb = torch.tensor([[[[0.2, 0.1, 0.0], [0.0, 0.0, 0.0], [0.9, 0.8, 0.7]]]], dtype=torch.float64)
    opacity = torch.tensor([[[0.5, 0.0, 1.0]]], dtype=torch.float64)
    background = torch.full((1, 3, 1, 3), 0.4, dtype=torch.float64)
    got = composite(rgb, opacity, background)
    want = torch.tensor([[0.4, 0.4, 0.9], [0.3, 0.4, 0.8], [0.2, 0.4, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(got[0, :, 0], want)


@pytest.mark.usefixtures("wrong_shapes")
def test_composite_refuses_channels_in_the_wrong_place() -> None:
    with pytest.raises(ValueError, match=r"got \(2, 3, 4, 4\)"):
        composite(torch.zeros(2, 3, 4, 4), torch.zeros(2, 4, 4), torch.zeros(2, 3, 4, 4))


def test_shift_equals_slicing() -> None:
    image = torch.rand(3, 5, 7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    shifted = apply_shift(image, torch.tensor([[2, -1], [0, 0], [-3, 4]]))
    want = torch.zeros_like(image)
    want[0, :-1, 2:] = image[0, 1:, :-2]
    want[1] = image[1]
    want[2, 4:, :-3] = image[2, :-4, 3:]
    assert torch.equal(shifted, want)


def test_shift_and_back_returns_what_stayed_inside() -> None:
    image = torch.zeros(1, 8, 8)
    image[:, 3:5, 3:5] = torch.rand(2, 2, generator=torch.Generator().manual_seed(2))
    shift = torch.tensor([[3, -3]])
    assert torch.equal(apply_shift(apply_shift(image, shift), -shift), image)


def test_shift_out_of_frame_is_zero_even_beside_a_nan() -> None:
    image = torch.full((1, 4, 4), torch.nan)
    assert torch.equal(apply_shift(image, torch.tensor([[4, 0]])), torch.zeros(1, 4, 4))
    assert torch.equal(apply_shift(image, torch.tensor([[0, -9]])), torch.zeros(1, 4, 4))


def test_the_derivative_of_a_shift_is_the_opposite_shift() -> None:
    """<shift(x), y> = <x, unshift(y)>: shifting is linear, and its adjoint is known."""
    generator = torch.Generator().manual_seed(3)
    x, y = torch.rand(2, 4, 6, 5, generator=generator, dtype=torch.float64)
    shift = torch.tensor([[1, 2], [-2, 0], [4, -5], [0, 1]])
    leaf = x.clone().requires_grad_()
    (got,) = torch.autograd.grad(apply_shift(leaf, shift), leaf, y)
    assert torch.equal(got, apply_shift(y, -shift))


def test_drawn_shifts_are_uniform_over_the_whole_range() -> None:
    shift = draw_shift(20000, 0.1, 20, 30, torch.Generator().manual_seed(4))
    for axis, reach in ((0, 3), (1, 2)):
        counts = torch.bincount(shift[:, axis] + reach, minlength=2 * reach + 1)
        assert len(counts) == 2 * reach + 1
        expected = 20000 / len(counts)
        assert ((counts - expected).abs() < 5 * expected**0.5).all()
    assert not draw_shift(100, 0.0, 20, 30, torch.Generator()).any()


DOUBLE = torch.float64


def test_layers_equal_painting_from_the_farthest_to_the_nearest():
    generator = torch.Generator().manual_seed(0)
    opacity = torch.rand(3, 4, 5, 6, generator=generator, dtype=DOUBLE)
    colour = torch.rand(3, 4, 5, 6, 3, generator=generator, dtype=DOUBLE)
    background = torch.rand(3, 3, 5, 6, generator=generator, dtype=DOUBLE)
    image, visible = stacked(colour * opacity[..., None], opacity, background)
    painted, left = background, torch.ones(3, 5, 6, dtype=DOUBLE)
    for layer in reversed(range(4)):
        cover = opacity[:, layer, None]
        painted = cover * colour[:, layer].movedim(-1, 1) + (1.0 - cover) * painted
    torch.testing.assert_close(image, painted, rtol=1e-12, atol=1e-12)
    for layer in range(4):
        torch.testing.assert_close(visible[:, layer], left * opacity[:, layer], rtol=1e-12, atol=1e-12)
        left = left * (1.0 - opacity[:, layer])


def test_the_nearest_lies_in_front_and_order_decides_among_equals():
    distance = torch.tensor([[3.0, 1.0, 2.0], [2.0, 2.0, 1.0]])
    order = torch.tensor([[0.9, 0.5, 0.1], [0.7, 0.3, 0.9]])
    assert by_depth(distance, order).tolist() == [[1, 2, 0], [2, 1, 0]]


def test_a_box_is_of_what_is_visible_and_a_hidden_object_has_none():
    opacity = torch.zeros(1, 3, 12, 12)
    opacity[0, 0, 2:8, 2:8] = 1.0
    opacity[0, 1, 2:8, 4:12] = 1.0  # four of its eight columns lie behind the first
    opacity[0, 2, 3:7, 3:9] = 1.0  # between both: nothing is left of it
    _, visible = stacked(opacity[..., None].expand(-1, -1, -1, -1, 3), opacity, torch.zeros(1, 3, 12, 12))
    boxes, present = visible_boxes(opacity, visible, 0.5, 1.0, 0.1)
    assert present.tolist() == [[True, True, False]]
    assert boxes[0].tolist() == [[2.0, 2.0, 8.0, 8.0], [8.0, 2.0, 12.0, 8.0], [0.0] * 4]
    assert visible_boxes(opacity, visible, 0.5, 1.0, 0.51)[1].tolist() == [[True, False, False]]
    assert visible_boxes(opacity, visible, 0.5, 25.0, 0.0)[1].tolist() == [[True, False, False]]


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


@pytest.mark.usefixtures("wrong_shapes")
def test_opacity_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\[n, h, w\], got shape \(1, 1, 4, 4\)"):
        boxes_from_opacity(torch.zeros(1, 1, 4, 4))
