"""Cameras as other programs export them, as transforms.json or COLMAP's text: read right, or refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from neural_sim.objects.motion import Colmap
from neural_sim.objects.photos import Photos

WIDTH, HEIGHT, FOCAL, COUNT = 48, 36, 56.0, 6
LENS = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 24.0, "cy": 18.0, "w": WIDTH, "h": HEIGHT}


def poses() -> list[np.ndarray]:
    """Camera to world, OpenGL axes, on a ring about the origin."""
    made = []
    for angle in np.linspace(0.0, 2.0 * np.pi, COUNT, endpoint=False):
        back = np.array([np.cos(angle), np.sin(angle), 0.3]) / np.linalg.norm([1.0, 0.3])
        right = np.cross([0.0, 0.0, 1.0], back) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], back))
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 2.5 * back], 1)
        made.append(pose)
    return made


def photographs(home: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        pixels[12:24, 16:32] = (20 * number, 90, 90, 255)
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(home / name)


def written(
    home: Path,
    top: dict[str, Any],
    frame: dict[str, Any],
    name: str = "images/frame_{:05d}.png",
    listed: str = "",
) -> None:
    """A transforms.json: keys of the file, keys of every frame, and names of the files as they are and as listed."""
    photographs(home, [name.format(n) for n in range(COUNT)])
    frames = [
        {"file_path": (listed or name).format(n), "transform_matrix": pose.tolist(), **frame}
        for n, pose in enumerate(poses())
    ]
    (home / "transforms.json").write_text(json.dumps({**top, "frames": frames}))


ANGLES = {"camera_angle_x": 2 * np.arctan(24 / FOCAL), "camera_angle_y": 2 * np.arctan(18 / FOCAL)}
NGP = {**ANGLES, **LENS, "k1": 0.0, "k2": 0.0, "k3": 0, "k4": 0, "p1": 0.0, "p2": 0.0, "is_fisheye": False}
EXPORTS: dict[str, Callable[[Path], None]] = {
    "nerfstudio": lambda home: written(
        home, {**LENS, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV",
               "applied_transform": np.eye(4)[[0, 2, 1]].tolist(), "ply_file_path": "sparse_pc.ply"},
        {"colmap_im_id": 3, "depth_file_path": "depth/frame_00001.png"}),
    "instant_ngp": lambda home: written(
        home, {**NGP, "aabb_scale": 16, "scale": 0.33, "offset": [0.5, 0.5, 0.5]}, {"sharpness": 31.4},
        listed="./images/frame_{:05d}.png"),
    "polycam": lambda home: written(home, {"camera_model": "OPENCV"}, {**LENS, "mask_path": None}),
    "reality_capture": lambda home: written(
        home, {"camera_model": "OPENCV"}, {**LENS, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0, "p2": 0},
        name="images/IMG_{:04d}.JPG.png", listed="images\\IMG_{:04d}.JPG.png"),
    "metashape": lambda home: written(home, {**LENS, "k1": 0.0, "camera_model": "OPENCV"}, {}),
    "record3d": lambda home: written(home, {**LENS, "camera_model": "OPENCV"}, {}, listed="images/frame_{:05d}"),
    "nerf_capture": lambda home: written(home, {}, {**LENS}, name="images/{}.png", listed="images/{}"),
    "blender": lambda home: written(home, ANGLES, {"rotation": 0.01}, listed="./images/frame_{:05d}"),
}  # fmt: skip


def colmap_text(
    home: Path, name: str = "{:03d}.png", change: Callable[[list[str]], list[str]] = lambda _: _
) -> None:
    """As Metashape and RealityScan write it: a camera for each image, numbers from 0, no rig or frame."""
    photographs(home / "images", [name.format(n) for n in range(COUNT)])
    model = home / "sparse" / "0"
    model.mkdir(parents=True)
    cameras = [f"{n} PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 24 18" for n in range(1, COUNT + 1)]
    (model / "cameras.txt").write_text("\n".join(["# Camera list", *cameras, ""]))
    lines = ["# Image list"]
    for number, pose in enumerate(poses()):
        moved = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        x, y, z, w = Rotation.from_matrix(moved[:3, :3]).as_quat()
        row = [number + 1, w, x, y, z, *moved[:3, 3], number + 1, name.format(number)]
        lines += [" ".join(map(str, row)), "3.5 7.25 -1"]
    (model / "images.txt").write_text("\n".join([*change(lines), ""]))


def with_other_models(home: Path) -> None:
    """Write models next to the photographs, as nerfstudio, instant-ngp and 3D Gaussian splatting do."""
    written(home, LENS, {}, name="images/frame_{:05d}.png")
    photographs(home / "images_2", [f"frame_{n:05d}.png" for n in range(COUNT)])
    for model in ("colmap/sparse/0", "colmap_text", "distorted/sparse/0"):
        (home / model).mkdir(parents=True)
        (home / model / "cameras.txt").write_text("damaged")


EXPORTS["with_other_models"] = with_other_models
EXPORTS["colmap_text"] = colmap_text
EXPORTS["colmap_folders"] = lambda home: colmap_text(home, "left/a b {}.png")


@pytest.mark.parametrize("export", EXPORTS)
def test_exports_have_every_camera_at_its_place(tmp_path: Path, export: str) -> None:
    EXPORTS[export](tmp_path / "thing")
    frames = Photos(tmp_path).captures["thing"].frames
    assert np.allclose([frame.camera_to_world for frame in frames], poses(), atol=1e-9)
    for number, frame in enumerate(frames):
        lens = frame.lens
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((FOCAL, FOCAL, 24.0, 18.0))
        assert not any((*lens.radial, *lens.divisor, *lens.tangential)) and not lens.fisheye
        assert np.asarray(Image.open(frame.image))[15, 20, 0] == 20 * number


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse"])
def test_a_root_with_photographs_is_one_object_wherever_its_model_lies(tmp_path: Path, place: str) -> None:
    colmap_text(tmp_path / "thing")
    (tmp_path / "thing" / "sparse" / "0").rename(tmp_path / "model")
    (tmp_path / "thing" / "sparse").rmdir()
    (tmp_path / "thing" / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "model").rename(tmp_path / "thing" / place)
    captures = Photos(tmp_path / "thing").captures
    assert list(captures) == ["thing"] and len(captures["thing"].frames) == COUNT


def test_what_programs_leave_next_to_photographs_is_no_object(tmp_path: Path) -> None:
    with_other_models(tmp_path / "thing")
    assert list(Photos(tmp_path / "thing").captures) == ["thing"]
    assert Photos(tmp_path / "thing", poses=Colmap()).names() == ["thing"]


def spoilt(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def made(home: Path) -> None:
        written(home, LENS, {})
        document = json.loads((home / "transforms.json").read_text())
        for frame in document["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        (home / "transforms.json").write_text(json.dumps(document))

    return made


def twice(home: Path) -> None:
    written(home, LENS, {})
    document = json.loads((home / "transforms.json").read_text())
    document["frames"].append({**document["frames"][0], "file_path": "./images/../images/frame_00000.png"})
    (home / "transforms.json").write_text(json.dumps(document))


def without_points(lines: list[str]) -> list[str]:
    return [line for line in lines if len(line.split()) != 3 or line.startswith("#")]


def one_name(lines: list[str]) -> list[str]:
    return [line.replace("001.png", "000.png") for line in lines]


def no_turn(lines: list[str]) -> list[str]:
    return [
        " ".join([*line.split()[:1], *"0000", *line.split()[5:]]) if ".png" in line else line
        for line in lines
    ]


REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "f-theta": (
        lambda home: written(home, {**LENS, "ftheta_p0": 1.0}, {}),
        r"frames\[0\].*: ftheta_p0: .*undistort",
    ),
    "divisor": (
        lambda home: written(home, LENS, {"k5": 0.2}),
        r"frames\[0\].*: k5: .*undistort the photographs",
    ),
    "unit of focal": (
        lambda home: written(home, {**LENS, "fl_x": 0.035}, {}),
        "focal lengths in pixels, 2.4 to 48000",
    ),
    "fractions": (
        lambda home: written(home, {**LENS, "cx": 0.5, "cy": 0.5}, {}),
        "cx and cy in pixels, got the frac",
    ),
    "transposed": (spoilt(np.transpose), r"transform_matrix: want 0, 0, 0, 1 as its last row, .*transposed"),
    "scaled": (spoilt(lambda pose: pose @ np.diag([2.0, 2.0, 2.0, 1.0])), r"not a rotation .*determinant 8"),
    "one place": (spoilt(lambda pose: np.array(poses()[0])), "its 6 cameras are all at"),
    "twice": (twice, r"two of its poses are of .*frame_00000\.png"),
    "no points": (
        lambda home: colmap_text(home, change=without_points),
        "want two lines for each image, .*is followed by",
    ),
    "one name": (lambda home: colmap_text(home, change=one_name), r"two of its poses are of .*000\.png"),
    "no turn": (lambda home: colmap_text(home, change=no_turn), "want a quaternion of length 1, got 0"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_would_be_read_wrong_is_refused(tmp_path: Path, kind: str) -> None:
    make, reason = REFUSED[kind]
    make(tmp_path / "thing")
    with pytest.raises(ValueError, match=rf"thing/(transforms\.json|sparse/0): .*{reason}"):
        Photos(tmp_path)


@pytest.mark.parametrize("change", [lambda pose: pose @ np.diag([1.0, -1.0, -1.0, 1.0]), np.linalg.inv])
def test_poses_of_other_axes_are_refused_where_the_object_is_placed(tmp_path: Path, change: Any) -> None:
    spoilt(change)(tmp_path / "thing")
    with pytest.raises(
        ValueError, match=r"thing.*(visual hull .* is empty; check masks, poses and axes|up has no direction)"
    ):
        Photos(tmp_path).placement("thing")


def test_masks_of_one_name_in_several_folders_are_refused(tmp_path: Path) -> None:
    colmap_text(tmp_path / "thing", name="cam{}/000.png")
    mask = tmp_path / "thing" / "masks" / "000.png"
    mask.parent.mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
    with pytest.raises(
        ValueError, match=r"masks/000\.png: its name makes it the mask of both .*cam0/000\.png and .*cam1"
    ):
        Photos(tmp_path)
