"""Captures as a COLMAP sparse model, text or binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neural_sim.extras import require
from neural_sim.interruption import signals_kept
from neural_sim.objects.capture import Capture, Frame, Lens, checked_pose
from neural_sim.pictures import by, read_header

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
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


def model_folder(folder: Path) -> Path | None:
    """Folder of a capture's sparse model, None without one."""
    for place in MODELS:
        if any((folder / place / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return folder / place
    return None


def read_colmap(folder: Path, name: str) -> Capture:
    """The capture of a folder with ``sparse/0`` (or ``sparse``, or the model itself) and ``images``.

    Raises:
        ValueError: a model that pycolmap cannot read (such as one of another version) or without posed images, an
            unknown camera model, an image that is missing or whose size is not its camera's.
    """
    model = model_folder(folder)
    if model is None:
        raise ValueError(
            f"{folder}: holds no COLMAP model; want one of {', '.join(MODELS)} with cameras.bin or .txt"
        )
    require("photos", str(model))
    with signals_kept():
        import pycolmap

    try:
        read = pycolmap.Reconstruction(str(model))
        posed = {number: image for number, image in read.images.items() if image.has_pose}
    except Exception as error:  # pycolmap raises whatever its C++ checks raise
        raise ValueError(
            f"{model}: pycolmap {pycolmap.__version__} cannot read this model: {error}"
        ) from error
    if not posed:
        raise ValueError(f"{model}: holds no image with a pose")
    images = folder / "images"
    frames = [
        _frame(posed[number], read, images if images.is_dir() else folder, model) for number in sorted(posed)
    ]
    frames.sort(key=lambda frame: str(frame.image))
    parts = sorted(path for path in model.iterdir() if path.is_file() and path.suffix in (".bin", ".txt"))
    return Capture(name, tuple(frames), model, (*parts, *(frame.image for frame in frames)))


def _frame(image: Any, read: Any, folder: Path, model: Path) -> Frame:
    where, path = f"{model}: image {image.name}", folder / image.name
    if not path.is_file():
        raise ValueError(f"{where}: no such image: {path}")
    lens = _lens(read.cameras[image.camera_id], where)
    header = read_header(path, f"{where}: {path}")
    if header.stored != (lens.width, lens.height):
        raise ValueError(
            f"{where}: the image has {by(header.stored)} pixels, its camera {image.camera_id} "
            f"{lens.width} x {lens.height}{header.turning}"
        )
    world_to_camera = np.eye(4)
    world_to_camera[:3] = image.cam_from_world().matrix()
    return Frame(path, checked_pose(np.linalg.inv(world_to_camera) @ OPENCV_TO_OPENGL, where), lens)


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
