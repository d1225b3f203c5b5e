"""Captures from COLMAP's sparse models, text or binary."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from neural_sim.extras import require
from neural_sim.interruption import signals_kept
from neural_sim.objects.capture import (
    ROTATION_TOLERANCE,
    Capture,
    Frame,
    Lens,
    checked_pose,
    say_missing,
)
from neural_sim.pictures import by, read_header

_log = logging.getLogger(__name__)

MODELS = ("sparse/*", "sparse", "colmap/sparse/*", "colmap/sparse", ".")
"""Folders that are searched for models, in this order. COLMAP numbers several models (``sparse/0``, ``sparse/1``); the
one with the most photographs is used."""
PLACES = ("images", "input")
"""Folders of photographs (``input`` in 3D Gaussian splatting tools); without either, the capture's own folder."""
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Names of each camera model's parameters, in COLMAP's order.
PARAMETERS: dict[str, str] = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}


def model_folders(folder: Path) -> list[Path]:
    """Return the folders of a capture's sparse models, from the first place that has any."""
    for place in MODELS:
        found = [folder] if place == "." else sorted(folder.glob(place))
        models = [one for one in found if any((one / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))]
        if models:
            return models
    return []


def read_colmap(folder: Path, name: str) -> Capture:
    """Read a capture from a folder with ``sparse/0`` (or ``sparse``, or the model itself) and ``images`` or ``input``.

    Raises:
        ValueError: there is no model, pycolmap cannot read it (for instance if it is of another version), it has no
            posed images, a camera model is unknown, all images are missing, or an image's size is not that of its
            camera.
    """
    models = model_folders(folder)
    if not models:
        raise ValueError(
            f"{folder}: holds no COLMAP model; want one of {', '.join(MODELS)} with cameras.bin or .txt"
        )
    require("photos", str(models[0]))
    each = [(model, *_model(model)) for model in models]
    model, read, with_pose = max(each, key=lambda one: len(one[2]))
    if not with_pose:
        raise ValueError(f"{model}: holds no image with a pose")
    if len(each) > 1:
        others = ", ".join(f"{path.name} ({len(has)})" for path, _, has in each if path != model)
        _log.warning(
            "%s: used because it has the most photographs (%d) of %d models; left out: %s",
            model, len(with_pose), len(each), others,
        )  # fmt: skip
    unposed = len(read.images) - len(with_pose)
    if unposed:
        _log.warning("%s: %d photographs have no pose and are left out", model, unposed)
    place = next((folder / name for name in PLACES if (folder / name).is_dir()), folder)
    have = {number: (place / image.name).is_file() for number, image in with_pose.items()}
    missing = sorted(str(place / image.name) for number, image in with_pose.items() if not have[number])
    say_missing(model, missing, len(with_pose))
    frames = [_frame(image, read, place, model) for number, image in with_pose.items() if have[number]]
    frames.sort(key=lambda frame: str(frame.image))
    parts = sorted(path for path in model.iterdir() if path.is_file() and path.suffix in (".bin", ".txt"))
    return Capture(name, tuple(frames), model, (*parts, *(frame.image for frame in frames)))


def _model(folder: Path) -> tuple[Any, dict[int, Any]]:
    """Read a model; return it and those of its images that have a pose."""
    with signals_kept():
        import pycolmap

    try:
        read = _reconstruction(folder)
        named = {
            number: image for number, image in read.images.items() if image.name is not None
        }  # reading a name decodes it, and may raise
        return read, {number: image for number, image in named.items() if image.has_pose}
    except Exception as error:  # pycolmap raises whatever its C++ checks raise
        reason = " ".join(str(error).split())
        raise ValueError(
            f"{folder}: pycolmap {pycolmap.__version__} cannot read this model: {reason}"
        ) from error


def _reconstruction(folder: Path) -> Any:
    """Read a model; its file of points may be missing, because nothing here needs it."""
    import pycolmap

    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    if suffix == ".bin":
        for name in ("cameras", "rigs", "frames", "images", "points3D"):
            if (folder / f"{name}.bin").is_file():
                _check_counts(folder / f"{name}.bin", name)
    if (folder / f"points3D{suffix}").is_file():
        read = pycolmap.Reconstruction(str(folder))
    else:
        with TemporaryDirectory() as made:
            for file in folder.glob(f"*{suffix}"):
                shutil.copy(file, made)
            (Path(made) / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
            read = pycolmap.Reconstruction(made)
    if suffix == ".txt":
        for number, name in _names(folder / "images.txt").items():
            read.images[number].name = name
    return read


def _check_counts(path: Path, kind: str) -> None:
    """Refuse a binary file whose counts point beyond its end; pycolmap would go on reading for hours.

    Raises:
        ValueError: the file is shorter than its counts say.
    """
    data, at = path.read_bytes(), 0

    def take(size: int) -> int:
        """Skip ``size`` bytes, and return the number that they encode."""
        nonlocal at
        at += size
        if at > len(data):
            raise ValueError(f"{path.name} ends too early: it is cut off, or a count in it is wrong")
        return int.from_bytes(data[at - size : at], "little")

    for _ in range(take(8)):
        if kind == "cameras":
            take(24)  # at least; the number of parameters depends on the camera model
        elif kind == "rigs":
            sensors = take(8) >> 32
            for number in range(sensors):
                take(8)
                if number and take(1):
                    take(56)
        elif kind == "frames":
            take(64)
            take(16 * take(4))
        elif kind == "images":
            take(64)
            end = data.find(b"\0", at)
            take(end + 1 - at if end >= 0 else len(data))
            take(24 * take(8))
        else:
            take(43)
            take(8 * take(8))


def _names(path: Path) -> dict[int, str]:
    """Return the full names of a text model's images, which pycolmap would cut at their first space.

    Raises:
        ValueError: images have no line of points after their own, so pycolmap would read only every second one.
    """
    names, lines = {}, iter(path.read_text(encoding="utf-8-sig").split("\n"))
    for line in lines:
        words = line.strip().split(None, 9)
        if words and not words[0].startswith("#"):
            names[int(words[0])] = words[9]
            points = next(lines, "").split()
            if len(points) % 3 or (points and not points[-1].lstrip("-").isdigit()):
                raise ValueError(
                    f"{path.name}: want two lines for each image, the second with its points or empty; the line of "
                    f"{words[9]} is followed by {' '.join(points):.60}"
                )
    return names


def _frame(image: Any, read: Any, folder: Path, model: Path) -> Frame:
    where, path = f"{model}: image {image.name}", folder / image.name
    pose, lens = posed(image, read, where)
    header = read_header(path, f"{where}: {path}")
    if header.stored != (lens.width, lens.height):
        raise ValueError(
            f"{where}: the image has {by(header.stored)} pixels, but camera {image.camera_id} has "
            f"{lens.width} x {lens.height}{header.turning}"
        )
    return Frame(path, pose, lens)


def posed(image: Any, read: Any, where: str) -> tuple[Float[np.ndarray, "4 4"], Lens]:
    """Return the camera-to-world matrix (OpenGL axes) and the lens of a model's image.

    Raises:
        ValueError: the pose is not a rotation, or the camera model is unknown.
    """
    moved = image.cam_from_world()
    length = float(np.linalg.norm(moved.rotation.quat))
    if not abs(length - 1.0) < ROTATION_TOLERANCE:
        raise ValueError(f"{where}: want a quaternion of length 1, got {length:g}")
    world_to_camera = np.eye(4)
    world_to_camera[:3] = moved.matrix()
    pose = checked_pose(np.linalg.inv(world_to_camera) @ OPENCV_TO_OPENGL, where)
    return pose, _lens(read.cameras[image.camera_id], where)


def _lens(camera: Any, where: str) -> Lens:
    kind = camera.model_name
    if kind not in PARAMETERS:
        raise ValueError(f"{where}: camera model {kind}: want one of {', '.join(PARAMETERS)}")
    given = dict(zip(PARAMETERS[kind].split(), (float(p) for p in camera.params), strict=True))
    fisheye = kind.endswith("FISHEYE")
    radial = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3")
    divisor = () if fisheye else ("k4", "k5", "k6")
    coefficients = [tuple(given.get(key, 0.0) for key in keys) for keys in (radial, divisor)]
    try:
        return Lens(
            camera.width, camera.height, given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0)),
            given["cx"], given["cy"], *(part if any(part) else () for part in coefficients),
            tangential=(given.get("p1", 0.0), given.get("p2", 0.0)), fisheye=fisheye,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
