"""Damaged inputs of every reader: refused in one line with the file, or read as the undamaged twin, or told in the log.

What is accepted with other values in the same form cannot be told from a file that holds them: a digit of a number, a
pixel of a format without a checksum. It is counted. With another form (a photograph, a box or an object less) it must
be told in the log.
"""

from __future__ import annotations

import functools
import json
import logging
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from damage import damaged
from PIL import Image
from posed_scenes import meshes_in_metres, photographs, write_bop, write_ycb_video
from scipy.spatial.transform import Rotation

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.saved_detector import DOCUMENT, WEIGHTS, SavedDetector
from neural_sim.detector.settings import Anchors, Backbone, Head, Losses
from neural_sim.masks import read_mask
from neural_sim.objects.photos import Photos
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.pictures import read_header, read_picture
from neural_sim.stages.psi_file import psi_of_file
from neural_sim.target.bop import BopScenes
from neural_sim.target.coco import CocoTarget
from neural_sim.target.frames import FrameName, FrameReader
from neural_sim.target.ycb_video import CLASSES, YcbVideoScenes

FAST = 16
"""Damaged copies of each kind in every run; all of them take seconds."""
MANY = 220
"""In the slow one."""
OBJECTS = {"035_power_drill": "drill", "025_mug": "mug"}
Result = list[Any]


@dataclass(frozen=True)
class Kind:
    """A folder of inputs: which of its files are damaged and how it is read.

    ``summed``: its format has checksums, so that other values are found; ``alone``: nothing else says its size.
    """

    root: Path
    files: Sequence[Path]
    read: Callable[[], Result]
    summed: bool = False
    alone: bool = False


def _frames(reader: FrameReader, names: Sequence[FrameName]) -> Result:
    found: Result = []
    for name in names:
        frame = reader.frame(name, depth=True)
        found += [str(frame.camera), frame.depth]
        found += [np.asarray(read_picture(frame.image))]
        for item in frame.objects:
            found += [item.name, item.object_to_camera, item.box, item.visibility, item.mask]
    return found


def _picture(root: Path, name: str, read: Callable[[Path], Any]) -> Callable[[], Result]:
    def values() -> Result:
        read_header(root / name)
        return [np.asarray(read(root / name))]

    return values


def pictures(root: Path) -> dict[str, Kind]:
    pixels = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    made = {}
    for end in ("png", "jpg", "tif", "webp", "bmp"):
        Image.fromarray(pixels).save(root / f"a.{end}")
        read = _picture(root, f"a.{end}", read_picture)
        made[end] = Kind(root, [root / f"a.{end}"], read, summed=end == "png", alone=end != "png")
    mask = np.zeros((30, 40), np.uint8)
    mask[5:20, 8:30] = 255
    Image.fromarray(mask).save(root / "mask.png")
    made["mask"] = Kind(root, [root / "mask.png"], _picture(root, "mask.png", read_mask), True)
    return made


def coco(root: Path) -> Kind:
    images, annotations = [], []
    for number in range(3):
        Image.new("RGB", (40, 30), (40 * number, 90, 90)).save(root / f"{number}.png")
        images.append({"id": number, "file_name": f"{number}.png", "width": 40, "height": 30})
        annotations += [
            {
                "id": 2 * number + n,
                "image_id": number,
                "category_id": n,
                "bbox": [4 + n, 5, 20, 15.5],
                "iscrowd": 0,
            }
            for n in range(2)
        ]
    categories = [{"id": 0, "name": "mug"}, {"id": 1, "name": "can"}]
    document = {"images": images, "annotations": annotations, "categories": categories}
    (root / "labels.json").write_text(json.dumps(document))

    def read() -> Result:
        found = CocoTarget(root / "labels.json").load(["mug", "can"], 30, 40)
        return [found.present.numpy(), found.boxes.numpy(), found.labels.numpy(), found.images.numpy()]

    return Kind(root, [root / "labels.json"] * 3 + [root / "0.png"], read)


def _poses(count: int) -> list[np.ndarray]:
    made = []
    for angle in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xz", [1.2, angle + np.pi / 2]).as_matrix()
        pose[:3, 3] = 2.5 * pose[:3, 2]
        made.append(pose)
    return made


def _photographs(root: Path, count: int) -> None:
    for number in range(count):
        pixels = np.zeros((18, 24, 4), np.uint8)
        pixels[6:12, 8:16] = (20 * number, 90, 90, 255)
        (root / "images").mkdir(exist_ok=True)
        Image.fromarray(pixels).save(root / "images" / f"{number}.png")


def _capture(root: Path) -> Callable[[], Result]:
    def read() -> Result:
        photos = Photos(root)
        capture = photos.captures[root.name]
        found: Result = []
        for frame in capture.frames:
            found += [frame.image.name, frame.camera_to_world, str(frame.lens), frame.test]
            found += [photos.pictures(root.name).rgba(frame).numpy()]
        return found

    return read


def transforms(root: Path) -> Kind:
    _photographs(root, 5)
    frames = [
        {"file_path": f"images/{n}.png", "transform_matrix": pose.round(6).tolist()}
        for n, pose in enumerate(_poses(5))
    ]
    top = {
        "fl_x": 30.0,
        "fl_y": 30.5,
        "cx": 12.0,
        "cy": 9.0,
        "w": 24,
        "h": 18,
        "k1": 0.01,
        "camera_model": "OPENCV",
    }
    (root / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    return Kind(root, [root / "transforms.json"] * 4 + [root / "images" / "2.png"], _capture(root))


def colmap(root: Path, binary: bool) -> Kind:
    _photographs(root, 5)
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 24 18 30 30.5 12 9 0.01 0 0 0\n")
    lines = []
    for number, pose in enumerate(_poses(5)):
        moved = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        x, y, z, w = Rotation.from_matrix(moved[:3, :3]).as_quat()
        lines += [" ".join(map(str, [number + 1, w, x, y, z, *moved[:3, 3], 1, f"{number}.png"])), ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("")
    if binary:
        import pycolmap

        read = pycolmap.Reconstruction(str(model))
        for path in model.iterdir():
            path.unlink()
        read.write_binary(str(model))
    files = sorted(path for path in model.iterdir() if path.stat().st_size > 8)
    return Kind(root, files, _capture(root))


def data_sets(root: Path) -> dict[str, Kind]:
    meshes = meshes_in_metres(OBJECTS)
    made = photographs(meshes, 1, 2)
    ycb = write_ycb_video(root / "ycb", made, meshes, CLASSES)
    bop = write_bop(root / "bop", made, meshes)
    files = [path for path in sorted(ycb.rglob("*-*")) if path.name.startswith("000001")]
    labels = [*sorted(bop.rglob("scene_*.json")), bop / "models" / "models_info.json"] * 2
    masks = sorted(bop.rglob("mask_visib/*.png"))[:1]
    classes = ("obj_000001", "obj_000002")

    def read() -> Result:
        reader = BopScenes(bop)
        names = [FrameName("test/000001", number) for number in reader.numbers("test/000001")]
        return [
            reader.class_names(["test/000001"]),
            [reader.centre(name) for name in classes],
            *_frames(reader, names),
        ]

    scenes = YcbVideoScenes(ycb)
    return {
        "ycb_video": Kind(ycb, files, lambda: _frames(scenes, scenes.names)),
        "bop": Kind(bop, [*labels, *masks], read),
    }


def model(root: Path) -> Kind:
    parts = {
        "backbone": Backbone(),
        "head": Head(channels=8, convs=1),
        "anchors": Anchors(),
        "losses": Losses(),
    }
    make = functools.partial(RetinaNet, **parts)
    detector = make(num_classes=2, image_size=(32, 48))
    SavedDetector(make, detector.init(torch.Generator().manual_seed(0)), ("mug", "can"), (32, 48)).save(root)

    def read() -> Result:
        saved = SavedDetector.load(root)
        settings = json.dumps(json.loads((root / DOCUMENT).read_text())["detector"], sort_keys=True)
        return [
            saved.class_names,
            saved.image_size,
            settings,
            [value.numpy() for value in saved.params.values()],
        ]

    return Kind(root, [root / DOCUMENT, root / WEIGHTS], read)


def psi(root: Path) -> Kind:
    bins = np.random.default_rng(3).dirichlet(np.ones(8), 2).round(12).tolist()
    document = {"psi": {"mug": {"pose": {"initial": bins[1], "learned": bins[0]}}, "can": {"pose": bins[1]}}}
    (root / "results.json").write_text(json.dumps(document))
    distribution = SceneDistribution.of([Pose()])

    def read() -> Result:
        return [psi_of_file(root, distribution, ["mug", "can"]).numpy()]

    return Kind(root, [root / "results.json"], read)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and np.array_equal(a, b)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def form(result: Any) -> Any:
    if isinstance(result, np.ndarray):
        return "array", result.shape, int(result.sum()) if result.dtype == bool and result.ndim < 3 else None
    return [form(one) for one in result] if isinstance(result, (list, tuple)) else type(result)


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
    def folder(name: str) -> Path:
        return tmp_path_factory.mktemp(name, numbered=False)

    return {
        **pictures(folder("pictures")), "coco": coco(folder("coco")), "transforms": transforms(folder("transforms")),
        "colmap_text": colmap(folder("colmap_text"), False), "colmap_binary": colmap(folder("colmap_binary"), True),
        **data_sets(folder("sets")), "model": model(folder("model")),
        "psi": psi(folder("psi")),
    }  # fmt: skip


def outcome(kind: Kind, file: Path, twin: Result, caplog: pytest.LogCaptureFixture) -> str:
    """What becomes of a damaged file: refused, equal, told, other values, or silent."""
    caplog.clear()
    try:
        found = kind.read()
    except ValueError as error:
        said = str(error)
        named = "\n" not in said and any(name in said for name in (file.name, file.stem, str(kind.root)))
        return "refused" if named else f"silent about its file: {said}"
    except Exception as error:
        return f"traceback {type(error).__name__}: {error} at {traceback.extract_tb(error.__traceback__)[-1]}"
    if same(found, twin):
        return "equal"
    if any(record.levelno >= logging.WARNING for record in caplog.records):
        return "told"
    valid = not kind.summed and (kind.alone or form(found) == form(twin))
    return "other values" if valid else "silent"


def run(
    kinds: dict[str, Kind], count: int, caplog: pytest.LogCaptureFixture, seed: int
) -> dict[str, Counter[str]]:
    counts: dict[str, Counter[str]] = {}
    generator = np.random.default_rng(seed)
    for name, kind in kinds.items():
        twin, counts[name] = kind.read(), Counter()
        for trial in range(count):
            file = kind.files[trial % len(kind.files)]
            sound = file.read_bytes()
            try:
                file.write_bytes(damaged(sound, generator))
                what = outcome(kind, file, twin, caplog)
                if what == "silent":
                    what = f"silent {file.name} {trial}"
                counts[name][what] += 1
            finally:
                file.write_bytes(sound)
    return counts


def check(counts: dict[str, Counter[str]]) -> None:
    bad = {
        name: [what for what in count if what.startswith(("silent", "traceback"))]
        for name, count in counts.items()
    }
    assert not any(bad.values()), bad
    assert all(count["refused"] for count in counts.values()), counts


@pytest.mark.filterwarnings("ignore")
def test_damage_is_refused_or_told_or_does_no_harm(kinds, caplog):
    check(run(kinds, FAST, caplog, 0))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_much_damage_is_refused_or_told_or_does_no_harm(kinds, caplog):
    counts = run(kinds, MANY, caplog, 1)
    for name, count in counts.items():
        print(f"{name}: {dict(count)}")
    check(counts)
