"""YCB-Video's layout: made frames read back, which frames are taken, what is refused, and the real sample."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from posed_scenes import (
    COLOURS,
    FACTOR,
    MATRIX,
    SIZE,
    change_meta,
    photographs,
    write_mat,
    write_ycb_video,
)

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.subjects import PhotographedField
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.camera import TargetCamera
from neural_sim.target.frames import FrameName
from neural_sim.target.pose_bins import bins_of_poses
from neural_sim.target.ycb_video import CLASSES, YcbVideoTarget
from neural_sim.types import LabelledImages

NAMES = ["035_power_drill", "025_mug", "019_pitcher_base"]
POSES = SceneDistribution.of([Pose()])


def of(root, **settings):
    return YcbVideoTarget(**{"root": root, "every": 1, **settings})


def test_what_is_written_is_read(shared_root, made):
    """Poses, camera, masks, depth and boxes of every frame, from MATLAB 5 and from HDF5."""
    target = of(shared_root)
    assert sum(len(part) for part in target.parts(0).values()) == len(made) == 9
    partly = 0
    for truth in made:
        frame = target.reader.frame(FrameName(f"{truth.scene:04d}", truth.number), depth=True)
        assert focal_lengths(frame.camera) == pytest.approx((MATRIX[0, 0], MATRIX[1, 1]), rel=1e-14)
        assert principal_point(frame.camera) == (MATRIX[0, 2] + 0.5, MATRIX[1, 2] + 0.5)
        assert tuple(item.name for item in frame.objects) == truth.names
        np.testing.assert_allclose(frame.depth, truth.depth, atol=0.5 / FACTOR + 1e-9)
        for number, (item, pose) in enumerate(zip(frame.objects, truth.poses, strict=True), 1):
            np.testing.assert_allclose(item.object_to_camera, pose, atol=1e-12)
            np.testing.assert_array_equal(item.mask, truth.labels == number)
            rows, columns = np.nonzero(truth.labels == number)
            assert item.box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            rows, columns = np.nonzero(truth.whole[number - 1])
            whole = (np.ptp(columns) + 1) * (np.ptp(rows) + 1)
            area = (item.box[2] - item.box[0]) * (item.box[3] - item.box[1])
            # The box of vertices ends within a pixel of that of pixels on every side.
            side = 1.0 / min(np.ptp(columns) + 1, np.ptp(rows) + 1)
            assert item.visibility == pytest.approx(min(1.0, area / whole), abs=4.0 * side)
            partly += item.visibility < 0.8
    assert partly > 0


def test_labelled_images_have_boxes_labels_and_bins(shared_root, made):
    """At half the size; bins are those of the truth's poses."""
    target, names = of(shared_root), [FrameName("0001", 2), FrameName("0002", 1)]
    loaded = target.load(names, NAMES, SIZE[1] // 2, SIZE[0] // 2, POSES, dict.fromkeys(NAMES))
    truths = [next(t for t in made if (t.scene, t.number) == (int(n.scene), n.number)) for n in names]
    assert loaded.images.shape == (2, 3, 45, 60) and loaded.bins.shape == loaded.labels.shape
    assert loaded.present.sum(1).tolist() == [3, 1] and loaded.bins[1, 1:].eq(-1).all()
    for row, truth in enumerate(truths):
        frame = target.reader.frame(names[row])
        bins = bins_of_poses(POSES, torch.from_numpy(truth.poses), None)
        for i, item in enumerate(frame.objects):
            assert NAMES[loaded.labels[row, i]] == item.name
            assert loaded.bins[row, i] == bins[i]
            torch.testing.assert_close(loaded.boxes[row, i], 0.5 * torch.tensor(item.box))
            inside = 2 * loaded.boxes[row, i].round().int()
            shown = (255 * loaded.images[row]).round().int().movedim(0, -1)
            near = (shown - torch.from_numpy(COLOURS[NAMES.index(item.name)]).int()).abs().amax(-1) < 30
            assert near[inside[1] // 2 : inside[3] // 2, inside[0] // 2 : inside[2] // 2].any()
    without = target.load(names, NAMES, 45, 60)
    assert without.bins.tolist() == [-1, -1]


def test_bins_by_image_and_by_box_join():
    def images(labels, bins):
        return LabelledImages(
            torch.zeros(1, 3, 4, 4), torch.zeros(1, len(labels), 4), torch.tensor([labels]), bins
        )

    one, two = images([0, -1], torch.tensor([5])), images([0, 1, -1], torch.tensor([[2, 3, -1]]))
    assert LabelledImages.concatenate([one, two]).bins.tolist() == [[5, -1, -1], [2, 3, -1]]
    assert LabelledImages.concatenate([one, one]).bins.tolist() == [5, 5]


def sets_of(target, names=NAMES, seed=3):
    camera = TargetCamera(60).camera(64, 40.0, target)
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.0)
    return target.sets(
        {name: PhotographedField(name, radius=0.06) for name in names}, POSES, camera, synthesizer, seed
    )


def test_scenes_are_split_whole(shared_root, caplog):
    target = of(shared_root)
    scenes = [{name.scene for name in part} for part in target.parts(1).values()]
    assert scenes[0] and scenes[1] and not scenes[0] & scenes[1] and len(scenes[0] | scenes[1]) == 3
    assert any(target.parts(seed) != target.parts(1) for seed in range(2, 9))
    with caplog.at_level(logging.INFO):
        made = sets_of(target)
    for part in made.values():  # the log counts boxes by bins from 1
        for label, name in enumerate(NAMES):
            own = (part.bins[part.labels == label] + 1).tolist()
            counted = ", ".join(f"{b}: {own.count(b)}" for b in sorted(set(own)))
            assert not own or f"{name} {counted}" in caplog.text
    assert {name: len(part) for name, part in made.items()} == {"val": 3, "test": 6}
    assert all(bool(part.bins[part.present].ge(0).all()) for part in made.values())
    assert made["val"].images.shape[-2:] == (45, 60)


def test_scenes_for_training_are_none_of_the_others(shared_root):
    """Of three scenes one each; those that are scored are the same with and without."""
    for seed in range(4):
        settings = {"val_fraction": 0.6}
        without = of(shared_root, **settings).parts(seed)
        parts = of(shared_root, train_fraction=0.5, **settings).parts(seed)
        scenes = {part: {name.scene for name in names} for part, names in parts.items()}
        assert set(parts) == {"train", "val", "test"} and parts["test"] == without["test"]
        assert sorted(parts["train"] + parts["val"]) == without["val"]
        assert all(len(own) == 1 for own in scenes.values()) and len(set.union(*scenes.values())) == 3
    made = sets_of(of(shared_root, train_fraction=0.5, val_fraction=0.6))
    assert {name: len(part) for name, part in made.items()} == {"train": 3, "val": 3, "test": 3}
    assert of(shared_root, train_fraction=0.5, val_fraction=0.6).training_count(0) == 3


def test_frames_of_several_scenes_can_be_kept_together(shared_root):
    """Here those of one number."""
    for seed in range(5):
        parts = of(shared_root, split_by=r"/00000(\d)").parts(seed)
        assert all(len({name.scene for name in part}) == 3 for part in parts.values())
        assert not {name.number for name in parts["val"]} & {name.number for name in parts["test"]}
    with pytest.raises(
        ValueError, match=r"target\.split_by: want a regular expression or null, got 'attribute:s'"
    ):
        of(shared_root, split_by="attribute:s")


def lists(root, **named):
    (root / "image_sets").mkdir()
    for name, lines in named.items():
        (root / "image_sets" / f"{name}.txt").write_text("\n".join(lines) + "\n")


def numbers(part):
    return [str(name) for name in part]


def test_every_so_manieth_frame_and_key_frames(root):
    parts = of(root, every=2).parts(0)
    assert sorted(numbers([*parts["val"], *parts["test"]])) == [
        f"{scene:04d}/{number:06d}" for scene in range(3) for number in (1, 3)
    ]
    lists(
        root,
        train=[f"{s}/{n:06d}" for s in ("0000", "0002") for n in (1, 2, 3)] + ["data_syn/000007"],
        keyframe=["0001/000002", "0001/000003"],
        other=["data/0000/000003"],
        mixed=["0001/000001"],
        wrong=["0001/x"],
        absent=["0003/000001", "0001/000001"],
    )
    parts = of(root, every=2).parts(0)
    assert numbers(parts["val"]) == ["0000/000001", "0000/000003", "0002/000001", "0002/000003"]
    assert numbers(parts["test"]) == ["0001/000002", "0001/000003"]  # all of them
    assert numbers(of(root, every=50, val_list="other").parts(0)["val"]) == ["0000/000003"]
    assert numbers(of(root, limit=2).parts(0)["val"]) == ["0000/000001", "0002/000001"]
    with pytest.raises(
        ValueError, match=r"scenes \['0001'\] are both in the part for validation and in the part"
    ):
        of(root, val_list="mixed")
    with pytest.raises(ValueError, match=r"target\.test_list: no such file: .*exam\.txt"):
        of(root, test_list="exam")
    with pytest.raises(ValueError, match=r"wrong\.txt: line 1: want <scene>/<frame>, got '0001/x'"):
        of(root, val_list="wrong")
    with pytest.raises(ValueError, match=r"absent\.txt: 1 of 2 frames have no image, the first 0003/000001"):
        of(root, val_list="absent")
    (root / "image_sets" / "train.txt").unlink()
    assert {name.scene for name in of(root).parts(0)["val"]} == {"0000", "0002"}


def test_a_frame_is_listed_once_and_lines_are_counted_as_they_stand(root, caplog):
    lists(
        root, keyframe=["0001/000002", "", "0001/000003", "0001/000002"], wrong=["0001/000002", "", "0001/x"]
    )
    assert numbers(of(root).parts(0)["test"]) == ["0001/000002", "0001/000003"]
    assert "keyframe.txt: 1 lines repeat a frame and are left out" in caplog.text
    with pytest.raises(ValueError, match=r"wrong\.txt: line 3: want <scene>/<frame>, got '0001/x'"):
        of(root, val_list="wrong")


def test_names_of_frames_are_numbers(root, caplog):
    folder = root / "data" / "0000"
    (folder / "._000001-color.png").write_bytes(b"left by macOS")
    assert len(of(root).reader.names) == 9 and "1 leftovers of other programs are left out" in caplog.text
    (folder / "copy-color.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"copy-color\.png: want <number>-color\.png"):
        of(root)


def test_classes_that_are_no_objects(shared_root, caplog):
    names = [FrameName("0000", 1)]
    with pytest.raises(
        ValueError, match=r"0000/000001-color\.png: shows 025_mug, which is not an object; objects are \['d"
    ):
        of(shared_root, classes={"035_power_drill": "drill"}).load(names, ["drill"], 45, 60)
    with caplog.at_level(logging.INFO):
        left = of(shared_root, classes={"035_power_drill": "drill"}, unmatched="leave_out").load(
            names, ["drill", "pan"], 45, 60
        )
    assert left.labels.tolist() == [[0]]
    assert (
        "left out: {'025_mug': 1, '019_pitcher_base': 1}" in caplog.text
        and "no class for object pan" in caplog.text
    )
    mapped = dict.fromkeys(NAMES[1:]) | {NAMES[0]: "drill"}
    assert of(shared_root, classes=mapped).load(names, ["drill"], 45, 60).labels.tolist() == [[0]]
    with pytest.raises(ValueError, match=r"target\.classes: \['teapot'\] are not classes of"):
        of(shared_root, classes={"teapot": None})
    with pytest.raises(
        ValueError, match=r"target\.classes: \['bore'\] are not objects; objects are \['drill'\]"
    ):
        of(shared_root, classes={"035_power_drill": "bore"}).load(names, ["drill"], 45, 60)


def test_hidden_and_small_objects_have_no_box(shared_root, caplog):
    target = of(shared_root)
    frames = [target.reader.frame(name) for part in target.parts(0).values() for name in part]
    names = [FrameName(frame.scene, frame.number) for frame in frames]
    seen = sorted(item.visibility for frame in frames for item in frame.objects)
    between = 0.5 * (seen[4] + seen[5])
    assert seen[4] < seen[5]
    with caplog.at_level(logging.INFO):
        some = of(shared_root, min_visibility=between).load(names, NAMES, 90, 120)
    assert some.present.sum() == len(seen) - 5
    assert f"5 objects less visible than {between:g} (target.min_visibility) get no box" in caplog.text
    with caplog.at_level(logging.WARNING):
        none = of(shared_root, minimum_side=1000.0).load(names, NAMES, 90, 120)
    assert not none.present.any()
    assert (
        f"{len(seen)} boxes with a side below 1000 px or outside their photographs are dropped" in caplog.text
    )


def test_several_cameras(root, made, caplog):
    target = of(root)
    assert TargetCamera().camera(8, 40.0, target) == target.reader.frame(FrameName("0000", 1)).camera
    change_meta(root, made[0], intrinsic_matrix=MATRIX * np.array([[1.01, 1.0, 1.0]] * 3))
    with caplog.at_level(logging.WARNING):
        camera = of(root).camera()
    assert focal_lengths(camera)[0] == pytest.approx(MATRIX[0, 0])
    assert "1 of 9 photographs were taken by other cameras" in caplog.text
    Image.fromarray(made[0].image[:60]).save(root / "data/0000/000001-color.png")
    with pytest.raises(ValueError, match=r"needs photographs of one size, got \[\(120, 60\), \(120, 90\)\]"):
        of(root).camera()


def test_the_digest_follows_contents_and_lists(root):
    digests = [of(root).digest(), of(root, val_fraction=0.5).digest()]
    for end in ("color.png", "label.png", "meta.mat", "box.txt"):
        file = root / "data" / "0001" / f"000002-{end}"
        file.write_bytes(file.read_bytes() + b" ")
        digests.append(of(root).digest())
    lists(root, train=["0000/000001"], keyframe=["0001/000001"])
    digests.append(of(root).digest())
    (root / "image_sets" / "keyframe.txt").write_text("0002/000001\n")
    digests.append(of(root).digest())
    assert digests[0] == digests[1] and len(set(digests)) == 7


@pytest.fixture(scope="module")
def sample(shared_data) -> Path:
    root = shared_data / "ycb_video_sample"
    if not root.is_dir():
        pytest.skip(f"no real frames: {root} does not exist")
    return root


def test_the_real_sample(sample):
    """Fifteen frames of three scenes: boxes round the masks agree with the data set's own, bins come from the poses."""
    target = of(sample, val_fraction=0.34)
    parts = target.parts(0)
    assert sum(map(len, parts.values())) == 15
    camera = target.camera()
    assert (camera.width, camera.height) == (640, 480)
    assert focal_lengths(camera) == pytest.approx((1066.778, 1067.487))
    names = sorted(
        {item.name for part in parts.values() for name in part for item in target.reader.frame(name).objects}
    )
    assert len(names) == 12
    for name in (name for part in parts.values() for name in part):
        frame = target.reader.frame(name, depth=True)
        for item in frame.objects:
            assert item.mask is not None and item.box is not None and 0.5 < item.visibility <= 1.0
            depth = frame.depth[item.mask & (frame.depth > 0)]
            # The surface lies about the origin or before it, by less than these objects are deep; 2 cm for the sensor.
            assert -0.02 < item.object_to_camera[2, 3] - np.median(depth) < 0.13
    made = sets_of(target, names)
    assert {len(part) for part in made.values()} == {5, 10}
    assert all(bool(part.bins[part.present].ge(0).all()) for part in made.values())
    steady = [part.bins[i] for part in made.values() for i in range(0, len(part), 5)]
    assert all(len(set(bins[bins >= 0].tolist())) > 1 for bins in steady)  # objects show different sides


def _reflected(poses):
    return poses * np.array([1.0, 1.0, -1.0, 1.0])[:, None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda poses: {"poses": poses[..., :2]}, r"poses: want 3 x 4 x 3, one for each of cls_indexes, got 3 x 4 x 2"),
        (lambda poses: {"poses": _reflected(poses)}, r"poses: 035_power_drill: .* is a reflection"),
        (lambda poses: {"poses": 1.1 * poses}, r"poses: 035_power_drill: .* is no rotation: .* by 0\.21"),
        (lambda poses: {"poses": poses * np.nan}, r"poses: 035_power_drill: rotation: want 9 finite numbers"),
        (lambda poses: {"poses": None}, r"lacks \['poses'\]"),
        (lambda poses: {"cls_indexes": np.array([[15.0], [14.0], [99.0]])},
         r"cls_indexes: want different numbers from 1 to 21"),
        (lambda poses: {"intrinsic_matrix": np.eye(3)[::-1]}, r"intrinsic_matrix: want \[\[fx, 0, cx\]"),
        (lambda poses: {"intrinsic_matrix": np.diag([0.0, 1.0, 1.0])},
         r"intrinsic_matrix: camera: fx and fy must be positive"),
        (lambda poses: {"intrinsic_matrix": MATRIX * [[3.0], [3.0], [1.0]]},
         r"intrinsic_matrix: the principal point \(183, 130\.5\) lies outside the image of 120 x 90"),
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
