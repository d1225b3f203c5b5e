"""The folder of an exported data set: its identity, a record of each image, files that are whole or do not exist."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim import documents
from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.documents import PART, parsed_json
from neural_sim.synthesis.export.images import ExportImage, ShownObject
from neural_sim.synthesis.export.masks import box_of, run_lengths
from neural_sim.types import PinholeCamera

MANIFEST = "manifest.json"
RECORDS = "records.jsonl"
LONGEST = 60
"""Number of characters after which messages cut a value."""


@dataclass(frozen=True)
class ExportFolder:
    """Images of one ``identity`` (all that they depend on except their number), to which more can be added."""

    root: Path
    identity: Mapping[str, Any]

    @contextmanager
    def opened(self) -> Iterator[dict[int, dict[str, Any]]]:
        """Yield the records of the existing images, in a folder that is ready for more.

        Raises:
            ValueError: the folder holds something else, or images with another identity; the message names the first
                difference.
        """
        self.check()
        path = self.root / MANIFEST
        if not path.is_file():
            write_json(path, {"identity": dict(self.identity), "images": []})
        remove_parts(self.root)
        yield read_records(self.root)

    def add(self, record: Mapping[str, Any]) -> None:
        """Add the record of an image whose files have been written."""
        path = self.root / RECORDS
        try:
            with path.open("a", encoding="utf-8") as stream:
                stream.write(line_of(record))
        except OSError as error:
            raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error

    def finish(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Write the manifest: every image's file and hash, and its objects' parameters and poses.

        ``records`` are in order and replace those in the folder, where images that were made again come last.
        """
        write_whole(self.root / RECORDS, "".join(line_of(record) for record in records))
        images = [
            {
                **{key: record[key] for key in ("number", "file", "sha256", "camera")},
                "objects": [
                    {"label": item["label"], "visibility": item["visibility"], **item["pose"]}
                    for item in record["objects"]
                ],
            }
            for record in records
        ]
        write_json(self.root / MANIFEST, {"identity": dict(self.identity), "images": images})

    def check(self, unknown: Collection[str] = ()) -> None:
        """Raise what ``opened`` raises, and leave nothing behind.

        Args:
            unknown: parts of the identity that are not known yet, and are not compared.
        """
        path = self.root / MANIFEST
        if self.root.exists() and not self.root.is_dir():
            raise ValueError(f"export.folder: {self.root} is a file, want a folder")
        self._try_to_write()
        if not path.is_file():
            if self.root.is_dir() and any(self.root.iterdir()):
                raise ValueError(
                    f"export.folder: {self.root} has files but no {MANIFEST}; want a new folder, or that of an export"
                )
            return
        try:
            known = dict(parsed_json(path.read_text(encoding="utf-8"))["identity"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"export.folder: {path} is not the manifest of an export ({error!r}); want another folder"
            ) from error
        before, now = (
            {key: value for key, value in tree.items() if key not in unknown}
            for tree in (known, json.loads(json.dumps(self.identity)))
        )
        different = first_difference(before, now)
        if different is not None:
            key, one, other = different
            raise ValueError(
                f"export.folder: the images of {self.root} were made with {key}={one}, now it is {other}; want the "
                "same settings, or another folder"
            )

    def _try_to_write(self) -> None:
        """Raise ``ValueError`` if no file can be made in the folder, or in the nearest one above it that exists."""
        try:
            place = next(path for path in (self.root, *self.root.absolute().parents) if path.exists())
            with tempfile.TemporaryFile(dir=place):
                pass
        except OSError as error:
            reason = error.strerror or error
            raise ValueError(f"export.folder: {self.root} cannot be written: {reason}") from error


def first_difference(before: Any, now: Any, key: str = "") -> tuple[str, str, str] | None:
    """Return the first key, with dots, at which two JSON trees differ, and both values, shortened; None if equal."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in [*before, *(name for name in now if name not in before)]:
            inner = f"{key}.{name}" if key else name
            found = first_difference(before.get(name), now.get(name), inner)
            if found is not None:
                return found
        return None
    return None if before == now else (key, _short(before), _short(now))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def record_of(
    image: ExportImage, camera: PinholeCamera, number: int, file: str, digest: str
) -> dict[str, Any]:
    """Return an image's record, from which annotation files of any format are assembled.

    Boxes are (x, y, width, height) in pixels along pixel edges; null if there is none. The record's camera follows
    OpenCV: (0, 0) is the centre of the upper left pixel. ``digest`` is the SHA-256 of the file's bytes.
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
    """Return width, height and OpenCV's camera matrix, in pixels."""
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
    """Read the records of a folder, by number, for images whose files exist.

    A line that a killed process left unfinished is not a record; the file is rewritten without such lines.

    Raises:
        ValueError: a file cannot be read.
    """
    path = folder / RECORDS
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
    """Return a record as a line of the file."""
    return json.dumps(record, allow_nan=False) + "\n"


def _parsed(lines: list[str]) -> Iterator[dict[str, Any]]:
    for line in lines:
        try:
            record = parsed_json(line)
        except ValueError:
            continue
        if isinstance(record, dict) and {"number", "file", "objects"} <= record.keys():
            yield record


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file, whole or not at all, and create its folder.

    Raises:
        ValueError: the system refuses to write it; the message has the file and the reason.
    """
    try:
        documents.write_whole(path, content)
    except OSError as error:
        raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error


def write_json(path: Path, document: Any, indent: int | None = None) -> None:
    """Write a JSON file, whole or not at all."""
    write_whole(path, json.dumps(document, allow_nan=False, indent=indent) + "\n")


def same_file(source: Path, path: Path) -> None:
    """Make ``path`` another name of ``source``, or a copy if the file system has no hard links."""
    if path.exists():
        return
    part = path.with_name(f".{path.name}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.unlink(missing_ok=True)
            try:
                os.link(source, part)
            except OSError:
                shutil.copyfile(source, part)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error


def remove_parts(folder: Path) -> None:
    """Remove the files that a killed process left unfinished."""
    for path in folder.rglob(f".*{PART}"):
        path.unlink(missing_ok=True)
