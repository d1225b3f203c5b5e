"""BOP scenes: made ones read back, which images are taken, the models beside them, what is refused."""

import json
import logging

import numpy as np
import pytest
import torch
from PIL import Image
from posed_scenes import FACTOR, MATRIX, SIZE, meshes_in_metres, photographs, write_bop

from neural_sim.cameras import focal_lengths, orbit, principal_point
from neural_sim.objects.bop import BOP
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.subjects import PhotographedField
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.bop import BopTarget
from neural_sim.target.camera import TargetCamera
from neural_sim.target.frames import FrameName

OBJECTS = {"obj_000001": "can", "obj_000002": "mug", "obj_000003": "drill"}
NAMES = list(OBJECTS)


@pytest.fixture(scope="module")
def meshes():
    return meshes_in_metres(OBJECTS)


@pytest.fixture(scope="module")
def made(meshes):
    return photographs(meshes, 3, 2)


@pytest.fixture
def root(made, meshes, tmp_path):
    return write_bop(tmp_path, made, meshes)


def of(root, **settings):
    return BopTarget(**{"root": root, "every": 1, **settings})


def name_of(item, split="test"):
    return FrameName(f"{split}/{item.scene + 1:06d}", item.number)


def test_what_is_written_is_read(root, made):
    """Poses in metres, camera, masks, depth, boxes and visibility of every image."""
    target = of(root)
    assert target.class_names == NAMES
    assert sum(len(part) for part in target.parts(0).values()) == len(made) == 6
    hidden = 0
    for truth in made:
        frame = target.reader.frame(name_of(truth), depth=True)
        assert focal_lengths(frame.camera) == pytest.approx((MATRIX[0, 0], MATRIX[1, 1]), rel=1e-14)
        assert principal_point(frame.camera) == (MATRIX[0, 2] + 0.5, MATRIX[1, 2] + 0.5)
        np.testing.assert_allclose(frame.depth, truth.depth, atol=0.5 / FACTOR + 1e-9)
        assert tuple(item.name for item in frame.objects) == truth.names
        for number, (item, pose) in enumerate(zip(frame.objects, truth.poses, strict=True)):
            np.testing.assert_allclose(item.object_to_camera, pose, atol=1e-12)
            mask, whole = truth.labels == number + 1, truth.whole[number]
            np.testing.assert_array_equal(item.mask, mask)
            rows, columns = np.nonzero(mask)
            assert item.box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert item.visibility == pytest.approx(mask.sum() / whole.sum())
            hidden += item.visibility < 0.9
    assert hidden > 0


def test_boxes_without_masks_are_the_same(root, made):
    target = of(root)
    boxes = [[item.box for item in target.reader.frame(name_of(truth)).objects] for truth in made]
    for file in root.glob("test/*/mask_visib/*.png"):
        file.unlink()
    assert [[item.box for item in of(root).reader.frame(name_of(truth)).objects] for truth in made] == boxes


def test_the_models_centre_is_that_of_the_loaded_mesh(root, meshes):
    """Objects loaded from ``models`` turn about the place that bins are told from."""
    target = of(root)
    for item in BOP(root / "models").load():
        np.testing.assert_allclose(
            target.reader.centre(item.name), item.transform[:3, 3], atol=1e-6
        )  # metres; PLY has float32
        np.testing.assert_allclose(
            target.reader.centre(item.name), meshes[item.name].bounds.mean(0), atol=1e-6
        )
    (root / "models" / "models_info.json").unlink()
    assert of(root).reader.centre("obj_000001") is None
    assert of(root).class_names == NAMES  # of what the images show


def test_bins_are_told_from_the_models_centre(meshes, tmp_path):
    """A camera of the orbit about each object's centre, in the middle of a bin, comes back as that bin."""
    distribution = SceneDistribution.of([Pose()])
    opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    made = []
    for b, item in enumerate(photographs(meshes, 4, 2, 1)):
        phi = torch.tensor([(b + 0.5) * np.pi / 4], dtype=torch.float64)
        camera = orbit(phi, torch.zeros(1, dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64))[
            0
        ].numpy()
        camera[:3, 3] += meshes[item.names[0]].bounds.mean(0)
        made.append(type(item)(**{**vars(item), "poses": (opencv @ np.linalg.inv(camera))[None]}))
    target = of(write_bop(tmp_path, made, meshes), min_visibility=0.0)
    loaded = target.load([name_of(item) for item in made], NAMES, 90, 120, distribution)
    assert loaded.bins[:, 0].tolist() == list(range(8))


def test_the_sets_of_a_run(root):
    target = of(root, classes=dict(zip(NAMES, ("a", "b", None), strict=True)))
    camera, synthesizer = (
        TargetCamera(60).camera(64, 40.0, target),
        Synthesizer(ProceduralClutter(), shift=0.0),
    )
    subjects = {name: PhotographedField(name) for name in ("a", "b")}
    made = target.sets(subjects, SceneDistribution.of([Pose()]), camera, synthesizer, 0)
    assert {name: part.images.shape for name, part in made.items()} == {
        "val": (2, 3, 45, 60), "test": (4, 3, 45, 60),
    }  # fmt: skip
    assert all(part.present.sum(1).tolist() == [2] * len(part) for part in made.values())
    assert all(bool(part.bins[part.present].ge(0).all()) for part in made.values())


def test_targets_and_folders_say_which_images(root, made, meshes):
    write_bop(root, [item for item in made if item.scene < 2], meshes, split="train_real")
    listed = [
        {"scene_id": s, "im_id": n, "obj_id": o, "inst_count": 1} for s, n in ((1, 2), (3, 1)) for o in (1, 2)
    ]
    (root / "test_targets_bop19.json").write_text(json.dumps(listed))
    parts = of(root, val="train_real").parts(0)
    assert list(map(str, parts["test"])) == ["test/000001/000002", "test/000003/000001"]
    assert [name.number for name in parts["val"]] == [1, 2, 1, 2]
    assert [name.number for name in of(root, val="train_real", every=2).parts(0)["val"]] == [1, 1]
    split = of(root).parts(0)  # without a folder of its own, val is a scene of the targets
    assert sorted(map(str, split["val"] + split["test"])) == ["test/000001/000002", "test/000003/000001"]
    assert str(of(root, val="test", test="train_real").parts(0)["test"][0]) == "train_real/000001/000001"
    with pytest.raises(ValueError, match=r"train_pbr: holds no scene"):
        of(root, val="train_pbr")
    (root / "test_targets_bop19.json").write_text('[{"im_id": 3}]')
    with pytest.raises(ValueError, match=r"test_targets_bop19\.json: \[0\]: lacks \['scene_id'\]"):
        of(root)
    for entry in (
        {"scene_id": None, "im_id": 3},
        {"scene_id": 1, "im_id": 1.5},
        {"scene_id": 1, "im_id": -1},
    ):
        (root / "test_targets_bop19.json").write_text(json.dumps([entry]))
        with pytest.raises(
            ValueError, match=r"bop19\.json: \[0\]: (scene|im)_id: want a whole number of at least 0"
        ):
            of(root)


def test_the_files_of_an_image_are_its_own(root, made):
    """Its masks are named rather than searched for among all of its scene."""
    target, folder = of(root), root / "test" / "000001"
    (folder / "mask_visib" / "000001_000099.png").write_bytes(b"")
    masks = [path for path in target.reader.files(name_of(made[0])) if path.parent.name == "mask_visib"]
    assert masks == [folder / "mask_visib" / f"000001_{i:06d}.png" for i in range(3)]


def test_a_grey_or_jpeg_image_is_found(root, made):
    folder = root / "test" / "000001"
    (folder / "rgb" / "000001.png").unlink()
    (folder / "gray").mkdir()
    Image.fromarray(made[0].image).convert("L").save(folder / "gray" / "000001.tif")
    assert of(root).reader.frame(name_of(made[0])).image.suffix == ".tif"
    Image.fromarray(made[0].image).save(folder / "rgb" / "000001.jpg")
    assert of(root).reader.frame(name_of(made[0])).image.suffix == ".jpg"


def edited(root, file, change):
    path = root / "test" / "000001" / f"{file}.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("scene_gt", lambda d: d["1"][1].pop("cam_R_m2c"), r"scene_gt\.json: 1\[1\]: lacks \['cam_R_m2c'\]"),
        ("scene_gt", lambda d: d["1"][1].update(cam_R_m2c=[2.0] * 9), r"scene_gt\.json: 1\[1\]: .* is no rotation"),
        ("scene_gt", lambda d: d["1"][1].update(cam_t_m2c=[2.0]), r"scene_gt\.json: 1\[1\]: cam_t_m2c: want 3 finite"),
        ("scene_gt", lambda d: d["1"][1].update(obj_id=1.5), r"scene_gt\.json: 1\[1\]: obj_id: want a whole number"),
        ("scene_gt", lambda d: d["1"].pop(), r"scene_gt\.json: 1: want a list of objects, and as many"),
        ("scene_gt_info", lambda d: d["1"][0].pop("visib_fract"),
         r"scene_gt_info\.json: 1\[0\]: lacks \['visib_fract'\]"),
        ("scene_gt_info", lambda d: d.pop("1"), r"scene_gt_info\.json: has no entry of image 1"),
        ("scene_camera", lambda d: d.pop("1"), r"scene_camera\.json: has no entry of image 1"),
        ("scene_camera", lambda d: d["1"].pop("cam_K"), r"scene_camera\.json: 1: lacks \['cam_K'\]"),
        ("scene_camera", lambda d: d["1"].update(cam_K=[1.0] * 9),
         r"scene_camera\.json: 1: cam_K: want \[\[fx, 0, cx\]"),
        ("scene_camera", lambda d: d["1"].update(width=640, height=480),
         r"scene_camera\.json: 1: is for images of 640 x 480 pixels, .*000001\.png has 120 x 90"),
    ],
)  # fmt: skip
def test_bad_entries_are_refused_with_file_and_key(root, made, file, change, message):
    edited(root, file, change)
    with pytest.raises(ValueError, match=rf"000001.{message}"):
        of(root).reader.frame(name_of(made[0]))


def test_a_pose_without_a_bin_is_refused_with_file_and_object(root, made):
    """An object's centre in the camera has no side from which it is seen."""
    centre = of(root).reader.centre("obj_000001")

    def at_the_camera(data):
        data["1"][0]["cam_R_m2c"] = np.eye(3).reshape(-1).tolist()
        data["1"][0]["cam_t_m2c"] = (-1000.0 * centre).tolist()

    edited(root, "scene_gt", at_the_camera)
    target, distribution = of(root, min_visibility=0.0), SceneDistribution.of([Pose()])
    with pytest.raises(
        ValueError, match=r"000001\.png: pose of obj_000001: want a camera away from the object"
    ):
        target.load([name_of(made[0])], NAMES, 90, 120, distribution)


def test_bad_files_are_refused(root, made):
    folder, name = root / "test" / "000001", name_of(made[0])
    Image.fromarray(np.zeros((8, 9), np.uint8)).save(folder / "mask_visib" / "000001_000002.png")
    with pytest.raises(ValueError, match=r"000001_000002\.png: is 9 x 8 pixels, its photograph 120 x 90"):
        of(root).reader.frame(name)
    (folder / "rgb" / "000001.png").unlink()
    with pytest.raises(ValueError, match=r"rgb/000001\.png: not a readable image"):
        of(root).reader.frame(name)
    (folder / "scene_gt.json").write_text("[]")
    with pytest.raises(ValueError, match=r"000001/scene_gt\.json: want entries by number"):
        of(root)
    (folder / "scene_gt.json").write_text("{")
    with pytest.raises(ValueError, match=r"000001/scene_gt\.json: not readable as JSON"):
        of(root)


def test_a_class_without_an_object_is_refused_by_its_image(root, made, caplog):
    with pytest.raises(ValueError, match=r"rgb/000001\.png: shows obj_000001, which is not an object"):
        of(root).load([name_of(made[0])], ["obj_000002"], 45, 60)
    with caplog.at_level(logging.INFO):
        left = of(root, unmatched="leave_out").load([name_of(made[0])], ["obj_000002"], SIZE[1], SIZE[0])
    assert left.labels.tolist() == [[0]] and "obj_000003" in caplog.text


def test_scenes_for_training_are_taken_from_those_that_are_not_scored(root):
    without = of(root, val_fraction=0.6).parts(1)
    parts = of(root, val_fraction=0.6, train_fraction=0.5).parts(1)
    assert parts["test"] == without["test"] and sorted(parts["train"] + parts["val"]) == without["val"]
    assert not {name.scene for name in parts["train"]} & {name.scene for name in parts["val"]}
    counts = [of(root, val_fraction=0.6, train_fraction=part).training_count(1) for part in (0.5, None)]
    assert counts == [len(parts["train"]), 0] and counts[0] > 0
