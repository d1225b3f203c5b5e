"""Reading COCO's annotation files."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)

REQUIRED: dict[str, tuple[str, ...]] = {
    "images": ("id", "file_name"),
    "categories": ("id", "name"),
    "annotations": ("image_id", "category_id", "bbox"),
}


def read_coco(path: Path) -> dict[str, Any]:
    """The file's document, with the sections and entries of ``REQUIRED``.

    Raises:
        ValueError: not JSON, or a section, an entry's key or a box's side that is missing.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    for section, keys in REQUIRED.items():
        entries = data.get(section) if isinstance(data, dict) else None
        if not isinstance(entries, list):
            raise ValueError(f"{path}: want a list {section!r}, as COCO has it")
        for number, entry in enumerate(entries):
            missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
            if missing:
                raise ValueError(f"{path}: {section}[{number}] lacks {missing}")
            if section == "annotations" and len(entry["bbox"]) != 4:
                raise ValueError(f"{path}: annotations[{number}].bbox must be x, y, width, height")
    return data


def labels_of_categories(
    categories: Sequence[Mapping[str, Any]],
    mapping: Mapping[str, str | None] | None,
    class_names: Sequence[str],
    path: Path,
    key: str,
) -> dict[Any, int | None]:
    """Category id -> class index, None for a category left out.

    ``mapping`` is category name -> class name, null to leave a category out; names not listed stand for themselves.
    ``path`` is the file and ``key`` the setting that has the mapping, for messages.

    Raises:
        ValueError: a category that is no class, or one in the mapping that the file has not.
    """
    mapping = dict(mapping or {})
    named = {entry["id"]: mapping.get(entry["name"], entry["name"]) for entry in categories}
    strange = sorted({name for name in named.values() if name is not None and name not in class_names})
    absent = sorted(set(mapping) - {entry["name"] for entry in categories})
    if strange or absent:
        raise ValueError(
            f"{path}: categories {strange or absent} are "
            f"{'no objects' if strange else 'not in the file'}; objects are {list(class_names)}, the file's "
            f"categories {[entry['name'] for entry in categories]}. Map them by {key}, "
            "{name: object} or {name: null} to leave one out"
        )
    for name in set(class_names) - set(named.values()):
        _log.warning("%s: no category for object %s, which gets no score", path, name)
    return {id: None if name is None else list(class_names).index(name) for id, name in named.items()}
