"""CO3D's captures against the cameras that they were made with."""

import gzip
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import DISTORTION, capture
from made_photographs import co3d, viewpoint, write_jgz
from PIL import Image

from neural_sim.objects.co3d import FORMATS, Co3d

ROOT = Path(__file__).parents[2]
K = {"fl_x": 210.0, "fl_y": 190.0, "cx": 104.0, "cy": 71.0, "w": 200, "h": 150}


def poses(count=5):
    """Random rigid camera_to_world, OpenGL axes, whose cameras look at what is near the origin."""
    random, found = np.random.default_rng(2), []
    for _ in range(count):
        at, up = random.normal(size=3), random.normal(size=3)
        back = at / np.linalg.norm(at)
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        pose = np.eye(4)
        pose[:3] = np.column_stack(
            [right, np.cross(back, right), back, 4.0 * back + 0.1 * random.normal(size=3)]
        )
        found.append(pose)
    return found


def entry(number, pose, kind=FORMATS[1], sequence="1_2_3", size=(150, 200), **changes):
    path = f"mug/{sequence}/images/{number}.png"
    return {"sequence_name": sequence, "frame_number": number, "image": {"path": path, "size": list(size)},
            "viewpoint": viewpoint(pose, K, kind), **changes}  # fmt: skip


def write(root, entries, scores=()):
    for each in entries:
        path = root / each["image"]["path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (200, 150)).save(path)
    write_jgz(root / "mug" / "frame_annotations.jgz", entries)
    if scores:
        rows = [{"sequence_name": name, "viewpoint_quality_score": score} for name, score in scores]
        write_jgz(root / "mug" / "sequence_annotations.jgz", rows)
    return root


@pytest.mark.parametrize("kind", FORMATS)
def test_points_land_where_the_cameras_say(tmp_path, kind):
    """By OpenCV's formula from the true pose, and by PyTorch3D's own from the file's numbers."""
    true = poses()
    root = write(tmp_path, [entry(number, pose, kind) for number, pose in enumerate(true)])
    (frames,) = (each.frames for each in Co3d(root).captures.values())
    points = np.random.default_rng(0).normal(0.0, 0.3, (20, 3))
    for frame, pose in zip(frames, true, strict=True):
        local = (points - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3]
        pixels, seen = frame.lens.project(torch.from_numpy(local))
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]).T  # x right, y down, z ahead
        wanted = np.stack([K["fl_x"] * x / z + K["cx"], K["fl_y"] * y / z + K["cy"]], -1)
        assert bool(seen.all()) and np.abs(pixels.numpy() - wanted).max() < 1e-6
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=1e-9)
        view = viewpoint(pose, K, kind)
        camera = points @ np.array(view["R"]) + view["T"]
        ndc = np.array(view["focal_length"]) * camera[:, :2] / camera[:, 2:] + view["principal_point"]
        half = np.array([100.0, 75.0]) if kind == FORMATS[0] else np.array([75.0, 75.0])
        assert np.abs(np.array([100.0, 75.0]) - ndc * half - wanted).max() < 1e-6


def test_a_capture_is_placed_as_the_same_in_another_format(tmp_path):
    """Views of the object are those of transforms.json of the same photographs, cameras and masks."""
    co3d(tmp_path / "co3d", ["can"])
    from neural_sim.objects.photos import Photos
    from neural_sim.objects.procedural import Procedural

    item, flat = Procedural(["can"]).load()[0], dict.fromkeys(DISTORTION, 0.0)
    capture(tmp_path / "other", "can", item=item, distortion=flat)
    ours, theirs = (
        kind.views("can", 6, 2, 32) for kind in (Co3d(tmp_path / "co3d"), Photos(tmp_path / "other"))
    )
    torch.testing.assert_close(ours.camera_to_world, theirs.camera_to_world, rtol=0, atol=1e-5)
    torch.testing.assert_close(ours.images, theirs.images, rtol=0, atol=1e-3)


def test_the_sequence_is_the_best_or_the_longest_or_the_one_asked_for(tmp_path):
    true = poses()
    entries = [entry(n, pose, sequence="long") for n, pose in enumerate(true[:3])]
    entries += [entry(n, pose, sequence="short") for n, pose in reversed(list(enumerate(true[:2])))]
    root = write(tmp_path, entries)
    lengths = lambda source: len(source.captures["mug"].frames)  # noqa: E731
    assert lengths(Co3d(root)) == 3 and lengths(Co3d(root, sequences={"mug": "short"})) == 2
    write(root, entries, [("long", 0.2), ("short", 0.9)])
    best = Co3d(root)
    assert [frame.image.name for frame in best.captures["mug"].frames] == ["0.png", "1.png"]
    assert best.digests() != Co3d(root, sequences={"mug": "long"}).digests()
    with pytest.raises(ValueError, match=r"mug has no sequence 'other', want one of long, short"):
        Co3d(root, sequences={"mug": "other"})
    with pytest.raises(ValueError, match=r"objects\.sequences: \['can'\] are not objects"):
        Co3d(root, sequences={"can": "long"})


def _without(key):
    def change(held):
        held["viewpoint"].pop(key)

    return change


def _set(key, value):
    def change(held):
        held["viewpoint"][key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without("R"), r"\[1\]\.viewpoint\.R: want 3 x 3 finite numbers, got None"),
        (_set("R", np.ones((3, 3)).tolist()), r"\[1\]\.viewpoint\.R and T: .* are not a rotation"),
        (_set("T", [0.0, 1.0]), r"\[1\]\.viewpoint\.T: want 3 finite numbers"),
        (_set("focal_length", "wide"), r"\[1\]\.viewpoint\.focal_length: want 2 numbers, got 'wide'"),
        (_set("focal_length", [-1.0, 1.0]), r"\[1\]\.viewpoint\.focal_length: want positive focal lengths"),
        (_set("intrinsics_format", "pixels"), r"\[1\]\.viewpoint\.intrinsics_format: want one of ndc_.*'pixels'"),
        (lambda held: held.pop("viewpoint"), r"\[1\]\.viewpoint: want a camera, got None"),
        (lambda held: held.pop("image"), r"\[1\]\.image\.path: want a file's path relative to the root"),
        (lambda held: held["image"].update(path="mug/none.png"), r"\[1\]\.image\.path: no such file: .*none\.png"),
        (lambda held: held["image"].update(size=[10, 20]), r"\[1\]\.image\.size: want height and width .*\[150, 200\]"),
        (lambda held: held.update(mask={"path": "mug/none.png"}), r"\[1\]\.mask\.path: no such file"),
        (lambda held: held.pop("sequence_name"), r"\[1\]\.sequence_name: want a string"),
    ],
)  # fmt: skip
def test_bad_annotations_are_refused_with_file_and_key(tmp_path, change, message):
    entries = [entry(number, pose) for number, pose in enumerate(poses(2))]
    root = write(tmp_path, entries)
    change(entries[1])
    write_jgz(root / "mug" / "frame_annotations.jgz", entries)
    with pytest.raises(ValueError, match=r"frame_annotations\.jgz: " + message) as caught:
        Co3d(root)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_refused(tmp_path):
    (tmp_path / "mug").mkdir()
    with pytest.raises(ValueError, match=r"holds no category folder with frame_annotations\.jgz"):
        Co3d(tmp_path)
    path = tmp_path / "mug" / "frame_annotations.jgz"
    for content in (b"[]", gzip.compress(b"{"), gzip.compress(json.dumps([{}]).encode())[:-4]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"frame_annotations\.jgz: not readable as gzipped JSON"):
            Co3d(tmp_path)
    write_jgz(path, [])
    with pytest.raises(ValueError, match=r"want a list of annotations, as in CO3D"):
        Co3d(tmp_path)


@pytest.mark.slow
def test_fields_are_fitted_to_it_through_the_command_line(tmp_path):
    root = co3d(tmp_path / "co3d", count=20)
    command = [sys.executable, "-m", "src.main", "objects=co3d", f"objects.root={root}", "task=classification",
               "scale=smoke", "progress=false", f"paths.store={tmp_path / 'store'}",
               f"paths.mlflow={tmp_path / 'mlflow.db'}", f"hydra.run.dir={tmp_path / 'run'}"]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-3000:]
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert set(results["ap"]["learned"]["per_class"]) == {"can", "mug"}
    assert all(fit["psnr"] > 12.0 for fit in results["fields"].values())
