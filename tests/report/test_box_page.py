"""The page of boxes: what it draws in photographs lies where the box is, and what is dragged is what is saved."""

import urllib.request

import numpy as np
import pytest
import torch
from captures import capture

from neural_sim.objects.photos import Photos
from neural_sim.report.box_page import EDGES, ORANGE, BoxPage, corners_of, drawn, first_box


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    made = capture(tmp_path_factory.mktemp("box"), "mug", count=6)
    return Photos(made.folder).captures["mug"]


@pytest.fixture
def page(photographed):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    saved = []
    page = BoxPage(photographed, first_box(photographed), lambda box: saved.append(box) or "saved", 8321)
    page.saved_boxes = saved
    yield page
    page.server.stop()


def test_a_box_has_eight_corners_and_twelve_edges_along_its_axes():
    corners = corners_of(((0.0, 1.0, 2.0), (3.0, 5.0, 9.0)))
    assert len({tuple(corner) for corner in corners}) == 8 and len(EDGES) == 12
    sides = sorted(float(np.abs(corners[a] - corners[b]).sum()) for a, b in EDGES)
    assert sides == [3.0] * 4 + [4.0] * 4 + [7.0] * 4
    assert all((corners[a] != corners[b]).sum() == 1 for a, b in EDGES)


def test_edges_are_drawn_where_the_camera_sees_them(photographed):
    frame, box = photographed.frames[0], first_box(photographed)
    shown = drawn(frame, box)
    rows, columns = np.nonzero((shown == ORANGE).all(-1))
    world_to_camera = np.linalg.inv(frame.camera_to_world)
    local = corners_of(box) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    lens = frame.lens.resized(shown.shape[1], shown.shape[0])
    pixels, seen = lens.project(torch.from_numpy(local))
    assert seen.all() and len(rows) > 100
    low, high = pixels.amin(0), pixels.amax(0)
    inside = (low.clamp(min=0) - 2, high - low + 4)
    assert (
        abs(columns.min() - max(float(low[0]), 0.0)) <= 2 and abs(rows.min() - max(float(low[1]), 0.0)) <= 2
    )
    assert columns.max() <= float(inside[0][0] + inside[1][0]) and rows.max() <= float(high[1]) + 2


def test_the_first_box_is_where_the_cameras_look(photographed):
    low, high = np.array(first_box(photographed))
    places = np.stack([frame.camera_to_world[:3, 3] for frame in photographed.frames])
    assert (low < high).all() and not ((places > low) & (places < high)).all(1).any()


def test_what_is_dragged_is_saved_whichever_corner_is_the_higher(page):
    with urllib.request.urlopen(page.address, timeout=20) as answer:
        assert answer.status == 200
    before = np.array(page.image.image)
    page.handles[0].position, page.handles[1].position = (
        np.array([0.5, 0.1, 0.2]),
        np.array([-0.5, 0.4, -0.2]),
    )
    page.moved()
    page.saved()
    assert np.allclose(page.saved_boxes, [((-0.5, 0.1, -0.2), (0.5, 0.4, 0.2))])
    assert page.told.content == "saved" and not np.array_equal(page.image.image, before)
    shown = np.array(page.image.image)
    page.number.value = 3
    page.show()
    assert not np.array_equal(page.image.image, shown)
