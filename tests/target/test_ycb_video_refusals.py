"""What is refused of YCB-Video's layout, with the file and the key."""

import numpy as np
import pytest
from PIL import Image
from posed_scenes import MATRIX, change_meta, photographs, write_mat, write_ycb_video

from neural_sim.target.frames import FrameName
from neural_sim.target.ycb_video import CLASSES, YcbVideoTarget


def of(root, **settings):
    return YcbVideoTarget(**{"root": root, "every": 1, **settings})


def _reflected(poses):
    return poses * np.array([1.0, 1.0, -1.0, 1.0])[:, None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda poses: {"poses": poses[..., :2]}, r"poses: want 3 x 4 x 3, one for each of cls_indexes, got 3 x 4 x 2"),
        (lambda poses: {"poses": _reflected(poses)}, r"poses: 035_power_drill: .* is a reflection"),
        (lambda poses: {"poses": 1.1 * poses}, r"poses: 035_power_drill: .* is no rotation, R R\^T is off .* by 0\.21"),
        (lambda poses: {"poses": poses * np.nan}, r"poses: 035_power_drill: rotation: want 9 finite numbers"),
        (lambda poses: {"poses": None}, r"lacks \['poses'\]"),
        (lambda poses: {"cls_indexes": np.array([[15.0], [14.0], [99.0]])},
         r"cls_indexes: want different numbers from 1 to 21"),
        (lambda poses: {"intrinsic_matrix": np.eye(3)[::-1]}, r"intrinsic_matrix: want \[\[fx, 0, cx\]"),
        (lambda poses: {"intrinsic_matrix": np.diag([0.0, 1.0, 1.0])},
         r"intrinsic_matrix: camera: fx and fy must be positive"),
        (lambda poses: {"intrinsic_matrix": MATRIX * [[3.0], [3.0], [1.0]]},
         r"intrinsic_matrix: the principal point \(183, 130\.5\) lies outside of the image of 120 x 90"),
    ],
)  # fmt: skip
def test_bad_meta_files_are_refused_with_file_and_key(root, made, change, message):
    poses = np.moveaxis(made[0].poses[:, :3], 0, -1)
    change_meta(root, made[0], **change(poses))
    with pytest.raises(ValueError, match=rf"0000/000001-meta\.mat: {message}"):
        of(root).reader.frame(FrameName("0000", 1))


def test_files_that_are_missing_or_of_another_size(root, made):
    target, name, stem = of(root), FrameName("0000", 1), root / "data" / "0000"
    label = stem / "000001-label.png"
    Image.fromarray(np.zeros((9, 9), np.uint8)).save(label)
    with pytest.raises(ValueError, match=r"000001-label\.png: is 9 x 9 pixels, its photograph 120 x 90"):
        target.reader.frame(name)
    Image.fromarray(np.full((90, 120), 4, np.uint8)).save(label)
    with pytest.raises(
        ValueError, match=r"label\.png: shows classes \[4\], of which 000001-meta\.mat has no pose"
    ):
        target.reader.frame(name)
    label.unlink()
    whole = target.reader.frame(name)  # without masks boxes are those of whole objects
    assert all(
        item.mask is None and item.visibility == 1.0 and item.box is not None for item in whole.objects
    )
    (stem / "000001-box.txt").write_text("035_power_drill 1 2 3\n")
    with pytest.raises(ValueError, match=r"000001-box\.txt: line 1: want a class and four numbers"):
        target.reader.frame(name)
    (stem / "000001-box.txt").write_text("035_power_drill 1 2 3 4\n")
    with pytest.raises(
        ValueError, match=r"000001-box\.txt: has no box of \w+, of which 000001-meta\.mat has a pose"
    ):
        target.reader.frame(name)
    (stem / "000001-meta.mat").write_text("nothing")
    with pytest.raises(ValueError, match=r"000001-meta\.mat: not a readable MATLAB file"):
        target.reader.frame(name)
    write_mat(
        stem / "000001-meta.mat",
        {
            "cls_indexes": np.ones((1, 1)),
            "poses": np.eye(3, 4),
            "intrinsic_matrix": MATRIX,
            "factor_depth": np.ones((1, 1)),
        },
    )
    (stem / "000001-color.png").unlink()
    with pytest.raises(ValueError, match=r"000001-color\.png: not a readable image"):
        target.reader.frame(name)


def test_a_folder_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"target\.root: nowhere is not a folder"):
        of("nowhere")


def test_one_scene_cannot_be_split(meshes, tmp_path):
    write_ycb_video(tmp_path, photographs(meshes, 1, 1), meshes, CLASSES)
    with pytest.raises(
        ValueError, match=r"want at least two scenes, one for val and one for test, got \['0000'\]"
    ):
        of(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no photographs for val"):
        of(tmp_path / "empty")
