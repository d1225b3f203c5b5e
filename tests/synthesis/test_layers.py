"""Layers in front of each other against painting them one after the other, and boxes of what stays visible."""

import torch

from neural_sim.synthesis.layers import by_depth, stacked, visible_boxes

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
