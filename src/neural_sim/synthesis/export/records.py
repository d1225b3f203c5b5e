"""What a data set remembers of each image: a line of JSON, from which annotation files of any format are assembled."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.synthesis.export.files import write_whole
from neural_sim.synthesis.export.images import ExportImage, ShownObject
from neural_sim.synthesis.export.masks import box_of, run_lengths
from neural_sim.types import PinholeCamera

FILE = "records.jsonl"


def record_of(
    image: ExportImage, camera: PinholeCamera, number: int, file: str, digest: str
) -> dict[str, Any]:
    """An image's record. Boxes are (x, y, width, height) in pixels along pixel edges; null where there is none.

    ``camera`` is in OpenCV's convention: (0, 0) is the centre of the upper left pixel. ``digest`` is the SHA-256 of the
    file's bytes.
    """
    shown = image.objects[0].placed.camera if image.objects else camera
    return {
        "number": number,
        "file": file,
        "sha256": digest,
        "camera": opencv_entry(shown),
        "objects": [_object(item, image) for item in image.objects],
    }


def opencv_entry(camera: PinholeCamera) -> dict[str, float]:
    """Width, height and OpenCV's camera matrix in pixels."""
    (fx, fy), (cx, cy) = focal_lengths(camera), principal_point(camera)
    size = {"width": camera.width, "height": camera.height}
    return size | {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}


def _object(item: ShownObject, image: ExportImage) -> dict[str, Any]:
    placed, draw = item.placed, item.placed.draw
    visible = int(item.visible.sum())
    numbers = {name: getattr(draw, name) for name in ("phi", "rho", "distance", "magnification", "weights")}
    pose = {name: value[0].tolist() for name, value in numbers.items() if value is not None}
    return {
        "label": placed.label,
        "labelled": item.labelled,
        "visibility": visible / item.pixels if item.pixels else 0.0,
        "pixels": {
            "all": item.pixels,
            "inside": int(item.full.sum()),
            "valid": int((image.depth[item.full] > 0.0).sum()),
            "visible": visible,
        },
        "box_visible": _sized(box_of(item.visible)),
        "box_full": _sized(item.box),
        "mask_visible": run_lengths(item.visible),
        "mask_full": run_lengths(item.full),
        "pose": {
            **pose,
            "bins": draw.bins[0].tolist(),
            "shift": list(placed.shift),
            "camera_to_world": placed.camera_to_world.tolist(),
        },
    }


def _sized(box: tuple[int, int, int, int] | None) -> list[int] | None:
    return None if box is None else [box[0], box[1], box[2] - box[0], box[3] - box[1]]


def read_records(folder: Path) -> dict[int, dict[str, Any]]:
    """The records of a folder by number, of images whose files are there. A line that a killed process left unfinished
    is no record; the file is rewritten without such lines.

    Raises:
        ValueError: a file that cannot be read.
    """
    path = folder / FILE
    if not path.is_file():
        return {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"export.folder: {path} cannot be read ({error}); want the file as it was written"
        ) from error
    found = {}
    for record in _parsed(lines):
        if (folder / record["file"]).is_file():
            found[record["number"]] = record
    if len(found) < len(lines):
        write_whole(path, "".join(line_of(record) for record in found.values()))
    return found


def line_of(record: Mapping[str, Any]) -> str:
    """A record's line of the file."""
    return json.dumps(record, allow_nan=False) + "\n"


def _parsed(lines: list[str]) -> Iterator[dict[str, Any]]:
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and {"number", "file", "objects"} <= record.keys():
            yield record
