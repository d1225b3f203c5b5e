"""Captures from ``transforms.json``: nerfstudio's, instant-ngp's, and NeRF-synthetic's three files."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neural_sim.documents import read_json
from neural_sim.objects.capture import Capture, Frame, Lens, checked_pose, say_missing
from neural_sim.pictures import Header, by, read_header

_log = logging.getLogger(__name__)

NAMES = ("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json")
SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG")
PARTS = ("train", "val", "test")
HELD_OUT = "held out"
"""Key that is added to a document, for the names of its test frames."""
POSE = "transform_matrix"
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular", "k5", "k6")
"""Keys of lenses that cannot be read: instant-ngp's, and the divisor of OpenCV's full model."""
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def has_transforms(folder: Path) -> bool:
    """Return whether a folder has ``transforms.json`` or ``transforms_train.json``."""
    return any((folder / name).is_file() for name in NAMES[:2])


def read_transforms(folder: Path, name: str) -> Capture:
    """Read the capture of a folder.

    It has ``transforms.json``, or ``transforms_train.json`` with optional ``_val`` and ``_test`` files, whose frames
    are test frames. The latter layout is Blender's, with +z up. A frame's intrinsics override the file's. Frames whose
    image is missing or whose pose is null are left out with a warning.

    Raises:
        ValueError: a file is not readable or has no frames, a frame has no pose or its matrix is not a rotation, all
            images are missing, an image's size is not that of its intrinsics, or the camera model is unknown.
    """
    whole = (folder / NAMES[0]).is_file()
    sources = (
        [folder / NAMES[0]] if whole else [folder / part for part in NAMES[1:] if (folder / part).is_file()]
    )
    frames: list[Frame] = []
    up = None if whole else (0.0, 0.0, 1.0)
    for source in sources:
        document = _read(source)
        up = _up(document, source) or up
        held_out = source.name in NAMES[2:]
        read = [
            _frame(entry, number, document, source, held_out)
            for number, entry in enumerate(document["frames"])
        ]
        unposed = [frame for frame in read if frame is None]
        if unposed:
            _log.warning("%s: %d photographs have no pose and are left out", source, len(unposed))
        missing = [frame for frame in read if isinstance(frame, str)]
        say_missing(source, missing, len(read) - len(unposed))
        frames += [frame for frame in read if isinstance(frame, Frame)]
    if not frames:
        raise ValueError(f"{sources[0]}: holds no photograph with a pose")
    files = [*sources, *(path for frame in frames for path in (frame.image, frame.mask) if path is not None)]
    return Capture(name, tuple(frames), sources[0], tuple(files), up)


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path)
    if (
        not isinstance(document, dict)
        or not isinstance(document.get("frames"), list)
        or not document["frames"]
    ):
        raise ValueError(f"{path}: want a list 'frames' with at least one frame")
    first: dict[str, int] = {}
    for number, entry in enumerate(document["frames"]):
        if not isinstance(entry, dict):
            continue  # ``_frame`` refuses it
        for key in ("file_path", "mask_path"):
            if isinstance(entry.get(key), str):
                entry[key] = entry[key].replace("\\", "/")
        written = entry.get("file_path")
        if isinstance(written, str) and first.setdefault(written, number) != number:
            raise ValueError(f"{path}: frames[{first[written]}] and frames[{number}] are both of {written!r}")
    return _with_own_lenses(_divided(document, path, first))


def _with_own_lenses(document: Mapping[str, Any]) -> dict[str, Any]:
    """Drop nulls, and copy the file's focal lengths and angles to frames that have none of their own."""
    common = {key: value for key, value in document.items() if value is not None}
    focal = {key: common.pop(key) for key in FOCAL if key in common}
    frames = []
    for entry in document["frames"]:
        own = entry
        if isinstance(entry, dict):
            own = {key: value for key, value in entry.items() if value is not None or key == POSE}
            own = own if any(key in own for key in FOCAL) else {**focal, **own}
        frames.append(own)
    return {**common, "frames": frames}


def _divided(document: dict[str, Any], path: Path, known: Mapping[str, int]) -> dict[str, Any]:
    """Apply nerfstudio's lists: ``val`` and ``test`` are test frames; with a ``train`` list, others are left out."""
    lists = {part: document[f"{part}_filenames"] for part in PARTS if f"{part}_filenames" in document}
    if not lists:
        return document
    for part, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{path}: {part}_filenames: want a list of file names, got {names!r}")
        lists[part] = [name.replace("\\", "/") for name in names]
        strange = [name for name in lists[part] if name not in known]
        if strange:
            raise ValueError(f"{path}: {part}_filenames: no frame has the file_path {strange[0]!r}")
    held = {name for part in PARTS[1:] for name in lists.get(part, ())}
    listed = held | set(lists.get("train", known))
    others = set(known) - listed
    frames = [
        e for e in document["frames"] if not isinstance(e, dict) or str(e.get("file_path")) not in others
    ]
    counts = ", ".join(f"{part} {len(names)}" for part, names in lists.items())
    _log.info("%s: frames are split as its lists of file names say (%s)", path, counts)
    if len(frames) < len(document["frames"]):
        left = len(document["frames"]) - len(frames)
        _log.warning("%s: %d frames are in none of its lists of file names and are left out", path, left)
    return {**document, "frames": frames, HELD_OUT: held}


def _up(document: Mapping[str, Any], path: Path) -> tuple[float, float, float] | None:
    """Read instant-ngp's ``up``."""
    if "up" not in document:
        return None
    up = document["up"]
    if (
        not isinstance(up, list)
        or len(up) != 3
        or not any(up)
        or any(type(x) not in (int, float) for x in up)
    ):
        raise ValueError(f"{path}: up: want three numbers that are not all zero, got {up!r}")
    return float(up[0]), float(up[1]), float(up[2])


def _frame(
    entry: Any, number: int, document: Mapping[str, Any], source: Path, test: bool
) -> Frame | str | None:
    """Return an entry's frame; the path as written if its image is missing; None if its pose is null."""
    where = f"{source}: frames[{number}]"
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise ValueError(f"{where}: want a file_path, got {entry!r}")
    where = f"{where} ({entry['file_path']})"
    if POSE not in entry:
        raise ValueError(f"{where}: has no pose; want a {POSE}, null if none was found")
    if entry[POSE] is None:
        return None
    pose = checked_pose(entry[POSE], f"{where}: {POSE}")
    image = _image(source.parent / entry["file_path"])
    if image is None:
        return entry["file_path"]
    lens = _lens({**document, **entry}, read_header(image, f"{where}: {image}"), where)
    mask = entry.get("mask_path")
    if mask is not None and not (source.parent / str(mask)).is_file():
        raise ValueError(f"{where}: mask_path: no such file: {source.parent / str(mask)}")
    held_out = test or entry["file_path"] in document.get(HELD_OUT, ())
    return Frame(image, pose, lens, None if mask is None else source.parent / mask, held_out)


def _image(path: Path) -> Path | None:
    """Find the image's file, None if there is none; NeRF-synthetic omits the suffix."""
    candidates = (path, *(path.with_name(path.name + suffix) for suffix in SUFFIXES))
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _lens(values: Mapping[str, Any], header: Header, where: str) -> Lens:
    def number(key: str, default: float) -> float:
        value = values.get(key, default)
        if type(value) not in (int, float) or not math.isfinite(value):
            raise ValueError(f"{where}: {key}: want a number, got {value!r}")
        return float(value)

    def focal(key: str, side: int) -> float:
        angle = number(key, 0.0)
        if not 0.0 < angle < math.pi:
            raise ValueError(f"{where}: {key}: want an angle in radians between 0 and pi, got {angle:g}")
        return 0.5 * side / math.tan(0.5 * angle)

    width, height = header.stored
    stated = round(number("w", width)), round(number("h", height))
    if stated != header.stored:
        raise ValueError(
            f"{where}: the image has {by(header.stored)} pixels, but its intrinsics w and h say "
            f"{by(stated)}{header.turning}"
        )
    model = values.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or bool(values.get("is_fisheye", False))
    if model not in (*PERSPECTIVE, "OPENCV_FISHEYE"):
        raise ValueError(
            f"{where}: camera_model: want one of {', '.join((*PERSPECTIVE, 'OPENCV_FISHEYE'))}, got {model!r}"
        )
    strange = [key for key in OTHER_LENSES if values.get(key)]
    if strange:
        raise ValueError(
            f"{where}: {strange[0]}: lenses with this key are not supported; undistort the photographs"
        )
    if "fl_x" not in values and "camera_angle_x" not in values:
        raise ValueError(f"{where}: want intrinsics fl_x or camera_angle_x, in the frame or in the file")
    fx = number("fl_x", 0.0) if "fl_x" in values else focal("camera_angle_x", width)
    fy = fx
    if "fl_y" in values:
        fy = number("fl_y", 0.0)
    elif "fl_x" not in values and "camera_angle_y" in values:
        fy = focal("camera_angle_y", height)
    cx, cy = number("cx", 0.5 * width), number("cy", 0.5 * height)
    if "w" not in values and "h" not in values and not (0.0 < cx < width and 0.0 < cy < height):
        raise ValueError(
            f"{where}: cx and cy ({cx:g}, {cy:g}) are outside the image's {by(header.stored)} pixels; its "
            "intrinsics are for another size: want w and h"
        )
    radial = tuple(number(f"k{i}", 0.0) for i in (1, 2, 3, 4))
    tangential = (number("p1", 0.0), number("p2", 0.0))
    try:
        return Lens(
            width, height, fx, fy, cx, cy,
            radial if any(radial) else (), (), tangential, fisheye,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
