import math

import pytest
import torch

from neural_sim.synthesis.boxes import SMALLEST_SLOPE, boxes_from_opacity, subpixel_edges

DOUBLE = torch.float64
DISC = torch.tensor([30.3, 25.8, 11.2], dtype=DOUBLE)


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


def ellipse(where: torch.Tensor, sharpness: float = 1.0, tilt: float = 0.0) -> torch.Tensor:
    """Smooth opacity [1, 56, 64] of an ellipse of half-axes r and 0.7 r about (x, y): half of it at the outline."""
    y, x = torch.meshgrid(
        torch.arange(56, dtype=DOUBLE) + 0.5, torch.arange(64, dtype=DOUBLE) + 0.5, indexing="ij"
    )
    u, v = x - where[0], y - where[1]
    along = math.cos(tilt) * u + math.sin(tilt) * v
    across = (math.cos(tilt) * v - math.sin(tilt) * u) / 0.7
    distance = (along.square() + across.square()).sqrt()
    return torch.sigmoid(sharpness * (where[2] - distance))[None]


@pytest.mark.parametrize("tilt", [0.0, 0.6])
@pytest.mark.parametrize("threshold", [0.5, 0.2])
def test_moving_edges_against_central_differences_of_the_subpixel_box(tilt: float, threshold: float) -> None:
    def edges(where: torch.Tensor) -> torch.Tensor:
        return subpixel_edges(ellipse(where, tilt=tilt), threshold)[0]

    jacobian = torch.autograd.functional.jacobian(edges, DISC)
    step = 1e-5
    for column, direction in enumerate(step * torch.eye(3, dtype=DOUBLE)):
        slope = (edges(DISC + direction) - edges(DISC - direction)) / (2 * step)
        torch.testing.assert_close(jacobian[:, column], slope, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_moving_edges_against_the_closed_form_of_an_ellipse(tilt: float) -> None:
    """Half-extents r sqrt(cos^2 + 0.49 sin^2), R the radius of curvature: rows miss up to 0.5 / R of the motion."""
    half_x = math.hypot(math.cos(tilt), 0.7 * math.sin(tilt))
    half_y = math.hypot(math.sin(tilt), 0.7 * math.cos(tilt))
    x, y, r = DISC.tolist()
    expected = torch.tensor([x - half_x * r, y - half_y * r, x + half_x * r, y + half_y * r], dtype=DOUBLE)
    # radius of curvature where the outline of half-axes a, b is outermost: (a b)^2 / extent^3, least at the long axis
    smallest = 0.7**2 * r
    edges = subpixel_edges(ellipse(DISC, tilt=tilt))
    assert (edges[0] - expected).abs().max() < 0.5**2 / (2 * smallest) + 0.02  # rows, linear crossing
    jacobian = torch.autograd.functional.jacobian(
        lambda where: subpixel_edges(ellipse(where, tilt=tilt))[0], DISC
    )
    moved = torch.tensor([[1, 0, -half_x], [0, 1, -half_y], [1, 0, half_x], [0, 1, half_y]], dtype=DOUBLE)
    assert (
        jacobian - moved
    ).abs().max() < 0.5 / smallest + 0.05  # and the crossing's slope, linear in a pixel


def test_an_outline_sharper_than_a_pixel_moves_right_on_average() -> None:
    """Linear crossings of a step go in jumps; over all its places within a pixel they go as far as the outline."""
    slopes = []
    for phase in torch.arange(64, dtype=DOUBLE) / 64:
        where = (DISC + torch.stack([phase, *torch.zeros(2)])).requires_grad_()
        left = subpixel_edges(ellipse(where, sharpness=8.0))[0, 0]
        slopes.append(torch.autograd.grad(left, where)[0][0])
    assert max(slopes) - min(slopes) > 1.0
    assert float(torch.stack(slopes).mean()) == pytest.approx(1.0, abs=1e-3)


def test_differentiable_boxes_have_the_same_values_and_the_edges_derivative() -> None:
    plain, present = boxes_from_opacity(ellipse(DISC))
    where = DISC.clone().requires_grad_()
    opacity = ellipse(where)
    boxes, still_present = boxes_from_opacity(opacity, differentiable=True)
    assert torch.equal(boxes, plain) and torch.equal(present, still_present)
    cotangent = torch.tensor([0.3, -1.0, 2.0, 0.7], dtype=DOUBLE)
    (found,) = torch.autograd.grad(boxes[0, 0] @ cotangent, where, retain_graph=True)
    (expected,) = torch.autograd.grad(subpixel_edges(opacity)[0] @ cotangent, where)
    torch.testing.assert_close(found, expected)
    assert not boxes_from_opacity(opacity)[0].requires_grad


def test_an_edge_at_the_frame_does_not_move() -> None:
    where = torch.tensor([4.0, 52.0, 11.2], dtype=DOUBLE).requires_grad_()
    opacity = ellipse(where)
    edges = subpixel_edges(opacity)
    assert edges[0, 0] == 0.0 and edges[0, 3] == 56.0
    slopes = [torch.autograd.grad(edge, where, retain_graph=True)[0] for edge in edges[0]]
    assert slopes[0].abs().max() == 0.0 and slopes[3].abs().max() == 0.0
    assert slopes[1][1] > 0.9 and slopes[2][0] > 0.9


def test_the_derivative_at_a_flat_edge_is_capped() -> None:
    """Opacity rises by 1e-6 a pixel through the threshold: the edge's place depends on opacity 1e6 times over."""
    opacity = (0.5 + 1e-6 * (torch.arange(20, dtype=DOUBLE) - 9.3)).expand(1, 12, 20).clone().requires_grad_()
    edges = subpixel_edges(opacity)
    assert edges[0, 0].item() == pytest.approx(9.8, abs=1e-6)
    (slope,) = torch.autograd.grad(edges[0, 0], opacity)
    assert slope.abs().sum().item() == pytest.approx(1 / SMALLEST_SLOPE)


def test_images_without_an_object_have_boxes_that_do_not_move() -> None:
    opacity = torch.zeros(2, 5, 6, dtype=DOUBLE)
    opacity[1, 2, 3] = 0.9  # present, but below the minimum area
    opacity.requires_grad_()
    boxes, present = boxes_from_opacity(opacity, minimum_area=2, differentiable=True)
    (slope,) = torch.autograd.grad(boxes.sum(), opacity)
    assert not present.any() and not boxes.any() and not slope.any()
    edges = subpixel_edges(opacity[:1])
    assert not edges.any()
