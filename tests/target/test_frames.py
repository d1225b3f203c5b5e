"""Frames refuse what contradicts itself, whoever reads them."""

import numpy as np
import pytest
from PIL import Image

from neural_sim.target.frames import Frame, PosedObject, box_of_mask, camera_of_matrix
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(8, 6, 0.7)


def item(**changes):
    pose = np.eye(4)
    pose[2, 3] = 0.5
    return PosedObject(
        **{"name": "mug", "object_to_camera": pose, "box": (1, 1, 3, 4), "visibility": 1.0, **changes}
    )


@pytest.mark.usefixtures("wrong_shapes")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"object_to_camera": np.eye(3)}, "mug: want a rigid 4 x 4 object_to_camera"),
        ({"object_to_camera": np.diag([1.0, 1.0, 1.0, 2.0])}, "mug: want a rigid 4 x 4 object_to_camera"),
        (
            {"object_to_camera": np.diag([2.0, 1.0, 1.0, 1.0])},
            r"mug: .* is no rotation: R R\^T differs from the identity by 3",
        ),
        ({"object_to_camera": np.diag([-1.0, 1.0, 1.0, 1.0])}, "mug: .* is a reflection"),
        ({"box": (3, 1, 3, 4)}, r"mug: want a box x0 < x1, y0 < y1, got \(3, 1, 3, 4\)"),
        ({"visibility": 1.1}, r"mug: visibility must lie in \[0, 1\], got 1\.1"),
    ],
)
def test_objects_that_are_none(changes, message):
    with pytest.raises(ValueError, match=message):
        item(**changes)


def test_sizes_agree(tmp_path):
    file = tmp_path / "a.png"
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(file)
    assert (
        Frame("s", 1, file, CAMERA, (item(mask=np.zeros((6, 8), bool)),), np.zeros((6, 8))).objects[0].name
        == "mug"
    )
    with pytest.raises(ValueError, match=r"a\.png: the mask of mug is 6 x 8 pixels, its camera 8 x 6"):
        Frame("s", 1, file, CAMERA, (item(mask=np.zeros((8, 6), bool)),))
    with pytest.raises(ValueError, match=r"a\.png: the depth is 4 x 6 pixels, its camera 8 x 6"):
        Frame("s", 1, file, CAMERA, (item(),), np.zeros((6, 4)))
    with pytest.raises(ValueError, match=r"a\.png: is 8 x 6 pixels, its camera 9 x 6"):
        Frame("s", 1, file, PinholeCamera(9, 6, 0.7), (item(),))
    with pytest.raises(ValueError, match=r"b\.png: not a readable image"):
        Frame("s", 1, tmp_path / "b.png", CAMERA, ())


def test_boxes_run_along_pixel_edges():
    mask = np.zeros((6, 8), bool)
    assert box_of_mask(mask) is None
    mask[2, 3] = True
    assert box_of_mask(mask) == (3.0, 2.0, 4.0, 3.0)
    mask[5, 7] = True
    assert box_of_mask(mask) == (3.0, 2.0, 8.0, 6.0)


def test_camera_matrices_that_are_none():
    with pytest.raises(ValueError, match=r"^file: want 9 numbers, got \['a'\]"):
        camera_of_matrix(["a"], 8, 6, "file")
    with pytest.raises(ValueError, match=r"^file: want \[\[fx, 0, cx\]"):
        camera_of_matrix([5, 0.1, 3, 0, 5, 2, 0, 0, 1], 8, 6, "file")  # skew
    with pytest.raises(
        ValueError, match=r"^file: the principal point \(3, 5\.6\) lies outside the image of 8 x 6"
    ):
        camera_of_matrix([5, 0, 3, 0, 5, 5.6, 0, 0, 1], 8, 6, "file")
