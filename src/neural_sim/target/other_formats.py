"""Label files in other formats than COCO, recognised so that a message can say what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neural_sim.documents import read_json

_SUFFIXES = {
    ".yaml": "YOLO",
    ".yml": "YOLO",
    ".xml": "Pascal VOC or CVAT",
    ".csv": "tabular",
}
_CONVERT = (
    "want COCO's JSON: export it as COCO, or convert it (supervision: DetectionDataset.from_yolo(...) or "
    "from_pascal_voc(...), then as_coco(...))"
)
_KINDS = {
    "Label Studio's own format: export as COCO": {"data"},
    "a list of detections": {"image_id", "score"},
    "VIA's own format: export annotations as COCO": {"regions"},
    "VIA's project: export annotations as COCO": {"_via_settings"},
    "labelme's format: convert it to COCO": {"shapes"},
    "CreateML's format: convert it to COCO": {"image"},
}
"""The kind of a document, by keys that it or its first entry has."""


def missing_file(path: Path) -> str:
    """Explain that a path is not a file; for a folder, name the files in it that may be meant."""
    if not path.is_dir():
        return f"no such file: {path}"
    found = sorted(file.relative_to(path).as_posix() for file in path.glob("**/*.json"))
    if found:
        return f"{path} is a folder, want its COCO file: {', '.join(found[:6])}"
    other = next((file for end in _SUFFIXES for file in sorted(path.glob(f"**/*{end}"))), None)
    return f"{path} is a folder without a COCO file" if other is None else _of_another_kind(other)


def _of_another_kind(path: Path) -> str:
    return f"{path} belongs to a data set in {_SUFFIXES[path.suffix.lower()]} format; {_CONVERT}"


def read_sections(path: Path, sections: Sequence[str]) -> Mapping[str, Any]:
    """Read a JSON file that has a list for each of these names.

    Raises:
        ValueError: it is not JSON, or a list is missing; the message has the actual format, if it is recognised.
    """
    if path.suffix.lower() in _SUFFIXES:
        raise ValueError(_of_another_kind(path))
    document = read_json(path)
    for section in sections:
        if not isinstance(document.get(section) if isinstance(document, dict) else None, list):
            kind = _kind_of(document)
            raise ValueError(
                f"{path}: want a list {section!r}, as COCO has it" + (f"; this is {kind}" if kind else "")
            )
    return document


def _kind_of(document: object) -> str:
    """Return the name of a document's format; empty if it is unknown."""
    first = document[0] if isinstance(document, list) and document else document
    if not isinstance(first, dict):
        return ""
    keys = set(first)
    if any(isinstance(value, dict) and "regions" in value for value in first.values()):
        keys.add("regions")
    return next((kind for kind, marks in _KINDS.items() if marks <= keys), "")
