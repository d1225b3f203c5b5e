import numpy as np
import pytest

from neural_sim.synthesis.export.masks import box_of, mask_of, outlines, polygon, run_lengths


def even_odd(corners: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Pixels whose centre is inside of a closed polygon: crossings of a ray to the right, counted."""
    inside = np.zeros(shape, int)
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
        if y0 != y1:
            crosses = (np.minimum(y0, y1) < y) & (y < np.maximum(y0, y1))
            inside += crosses & (x0 + (y - y0) * (x1 - x0) / (y1 - y0) > x)
    return inside % 2 == 1


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("seed", range(3))
def test_a_polygon_is_its_mask(part, seed):
    """Masks of many parts, holes and corners that touch."""
    mask = np.random.default_rng(seed).random((13, 17)) < part
    corners = polygon(mask)
    assert np.array_equal(even_odd(corners, mask.shape), mask)
    assert (*corners.min(0), *corners.max(0)) == box_of(mask)


def test_outlines_go_clockwise_round_parts_and_the_other_way_round_holes():
    mask = np.zeros((6, 8), bool)
    mask[1:5, 2:7] = True
    mask[2:4, 3:5] = False
    outer, hole = outlines(mask)
    assert outer.tolist() == [[2, 1], [7, 1], [7, 5], [2, 5]]
    assert sorted(hole.tolist()) == [[3, 2], [3, 4], [5, 2], [5, 4]]
    x, y = hole[:, 0], hole[:, 1]
    assert (
        x * np.roll(y, -1) - np.roll(x, -1) * y
    ).sum() == -8  # twice its area, negative: counter-clockwise


def test_pixels_that_touch_at_a_corner_are_two_parts():
    assert sorted(len(loop) for loop in outlines(np.eye(2, dtype=bool))) == [4, 4]


def test_an_empty_mask_has_no_outline():
    empty = np.zeros((3, 4), bool)
    assert outlines(empty) == [] and polygon(empty).shape == (0, 2) and box_of(empty) is None


def test_run_lengths_are_cocos():
    """An independent decoder of the uncompressed form: runs down the columns, beginning with zeros."""
    mask = np.random.default_rng(1).random((9, 7)) < 0.4
    encoded = run_lengths(mask)
    assert encoded["size"] == [9, 7] and np.array_equal(mask_of(encoded), mask)
    counts, at, values = [], 0, encoded["counts"].encode()
    while at < len(values):  # pycocotools/common/maskApi.c, rleFrString
        number, shift, more = 0, 0, True
        while more:
            byte = values[at] - 48
            number |= (byte & 0x1F) << (5 * shift)
            more, at, shift = bool(byte & 0x20), at + 1, shift + 1
            if not more and byte & 0x10:
                number |= -1 << (5 * shift)
        counts.append(number + (counts[-2] if len(counts) > 2 else 0))
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    assert np.array_equal(flat.reshape(7, 9).T, mask)
