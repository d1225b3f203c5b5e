"""The configured camera: by field of view, by camera matrix, by the target's own."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.target.camera import GivenCamera, TargetCamera, camera_of_entry
from neural_sim.target.coco import CocoTarget
from neural_sim.target.rendered import RenderedTarget
from neural_sim.types import PinholeCamera

RENDERED = RenderedTarget()
ENTRY = {"width": 64, "height": 48, "fx": 80.0, "fy": 72.0, "cx": 30.0, "cy": 25.0}


def labels(folder, **changes):
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(folder / "a.png")
    document = {"images": [{"id": 1, "file_name": "a.png", "width": 64, "height": 48}],
                "categories": [{"id": 1, "name": "mug"}], "camera": ENTRY,
                "annotations": [{"image_id": 1, "category_id": 1, "bbox": [8, 8, 20, 20]}]}  # fmt: skip
    path = folder / "labels.json"
    path.write_text(json.dumps({**document, **changes}))
    return path


def test_nothing_said_is_the_square_camera_of_the_views():
    assert GivenCamera().camera(96, 40.0, RENDERED) == PinholeCamera(96, 96, math.radians(40.0))
    assert GivenCamera(96, 64).camera(10, 30.0, RENDERED) == PinholeCamera(96, 64, math.radians(30.0))
    assert GivenCamera(field_of_view_deg=50.0).camera(8, 40.0, RENDERED).field_of_view == math.radians(50.0)


def test_a_camera_matrix_is_opencvs():
    made = GivenCamera(96, 64, fx=120.0, fy=110.0, cx=40.0, cy=35.5).camera(8, 40.0, RENDERED)
    assert (made.width, made.height) == (96, 64)
    assert focal_lengths(made) == pytest.approx((120.0, 110.0), rel=1e-14)
    assert principal_point(made) == (40.5, 36.0)  # OpenCV's origin is the middle of the first pixel
    assert principal_point(GivenCamera(96, 64, fx=120.0).camera(8, 40.0, RENDERED)) == (48.0, 32.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 8}, "width and height or neither"),
        ({"fy": 3.0}, "need fx"),
        ({"cx": 3.0}, "need fx"),
        ({"fx": 3.0, "field_of_view_deg": 40.0}, "fx or field_of_view_deg"),
    ],
)
def test_bad_cameras_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        GivenCamera(**settings)


def test_the_targets_own_camera_in_another_size(tmp_path):
    target = CocoTarget(labels(tmp_path))
    whole = TargetCamera().camera(8, 40.0, target)
    assert (whole.width, whole.height) == (64, 48)
    assert focal_lengths(whole) == pytest.approx((80.0, 72.0)) and principal_point(whole) == (30.5, 25.5)
    half = TargetCamera(32).camera(8, 40.0, target)
    assert (half.width, half.height) == (32, 24)
    assert focal_lengths(half) == pytest.approx((40.0, 36.0))
    assert principal_point(half) == (15.25, 12.75)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera": {**ENTRY, "k1": 0.1}}, r"labels.json: camera: .*k1"),
        ({"camera": {k: v for k, v in ENTRY.items() if k != "fy"}}, r"labels.json: camera: .*fy"),
        ({"camera": {**ENTRY, "fx": "wide"}}, r"labels.json: camera: .*fx"),
        ({"camera": {**ENTRY, "fx": 0}}, r"labels.json: camera: .*positive"),
        ({"camera": [1, 2]}, r"labels.json: camera: want whole numbers width, height"),
        ({"camera": {**ENTRY, "width": 64.5}}, r"labels.json: camera: .*unknown: width$"),
        ({"camera": {**ENTRY, "height": float("inf")}}, r"labels.json: camera: .*unknown: height$"),
        ({"camera": {**ENTRY, "width": 65}}, r"labels.json: a.png has 64 x 48 pixels, its camera 65 x 48"),
        (
            {"camera": {**ENTRY, "width": 128, "height": 96}, "images": [{"id": 1, "file_name": "a.png"}]},
            r"labels.json: a.png has 64 x 48 pixels, its camera 128 x 96",
        ),
    ],
)
def test_a_camera_entry_that_is_none_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        CocoTarget(labels(tmp_path, **changes)).camera()


def test_targets_without_a_camera_are_refused(tmp_path):
    path = labels(tmp_path)
    document = json.loads(path.read_text())
    del document["camera"]
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"labels.json: camera=from_target needs an entry 'camera'"):
        TargetCamera().camera(8, 40.0, CocoTarget(path))
    with pytest.raises(ValueError, match=r"from_target needs a target .* got RenderedTarget"):
        TargetCamera().camera(8, 40.0, RENDERED)


def test_an_entry_gives_the_rays_of_its_matrix():
    from neural_sim.cameras import pixel_rays

    made = camera_of_entry(ENTRY, "test")
    pixel = torch.tensor([0, 63, 47 * 64, 20 * 64 + 11])
    matrix = np.array([[80.0, 0.0, 30.0], [0.0, 72.0, 25.0], [0.0, 0.0, 1.0]])
    homogeneous = np.stack([pixel % 64, pixel // 64, np.ones(4)])
    expected = (
        np.linalg.inv(matrix) @ homogeneous * np.array([[1.0], [-1.0], [-1.0]])
    )  # OpenCV to OpenGL axes
    expected /= np.linalg.norm(expected, axis=0)
    rays = pixel_rays(made, torch.eye(4, dtype=torch.float64)[None], pixel)
    np.testing.assert_allclose(rays.directions.numpy(), expected.T, atol=1e-14)
