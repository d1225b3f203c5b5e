"""COCO's annotation files, read and checked as a whole, for targets and for pictures that a detector is tried on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.documents import read_json

REQUIRED: dict[str, tuple[str, ...]] = {
    "images": ("id", "file_name"),
    "categories": ("id", "name"),
    "annotations": ("image_id", "category_id", "bbox"),
}
Entry = dict[str, Any]
COCO_KIND = ("category", "categories")
"""What COCO calls a class, and several."""


@dataclass(frozen=True)
class CocoFile:
    """The sections of a file, with the keys of ``REQUIRED``; ``document`` is all that it holds."""

    path: Path
    document: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> CocoFile:
        """Read a file.

        Raises:
            ValueError: not JSON, or a section, an entry's key or a box's side that is missing.
        """
        document = read_json(path)
        for section, keys in REQUIRED.items():
            entries = document.get(section) if isinstance(document, dict) else None
            if not isinstance(entries, list):
                raise ValueError(f"{path}: want a list {section!r}, as COCO has it")
            for number, entry in enumerate(entries):
                missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
                if missing:
                    raise ValueError(f"{path}: {section}[{number}] lacks {missing}")
                if section == "annotations" and len(entry["bbox"]) != 4:
                    raise ValueError(f"{path}: annotations[{number}].bbox must be x, y, width, height")
        return cls(path, document)

    @property
    def images(self) -> list[Entry]:
        """The entries of images."""
        return self.document["images"]

    @property
    def annotations(self) -> list[Entry]:
        """The entries of boxes."""
        return self.document["annotations"]

    @property
    def category_names(self) -> list[str]:
        """The names of the categories."""
        return [entry["name"] for entry in self.document["categories"]]

    @property
    def crowds(self) -> int:
        """How many annotations are of crowds, which are no objects' boxes."""
        return sum(bool(item.get("iscrowd", 0)) for item in self.annotations)

    def by_id(self, labels: Mapping[str, int | None]) -> dict[Any, int | None]:
        """Return the labels of categories by their ids; ``labels`` are by their names."""
        return {entry["id"]: labels.get(entry["name"]) for entry in self.document["categories"]}

    def rows_by_image(self, labels: Mapping[Any, int | None]) -> dict[Any, list[int]]:
        """Return the places of annotations by image id: those of objects, without crowds.

        Args:
            labels: label by category id, None for a category that is no object.

        Raises:
            ValueError: an annotation of a category that is not declared.
        """
        names = {entry["id"]: entry["file_name"] for entry in self.images}
        rows: dict[Any, list[int]] = {}
        for row, item in enumerate(self.annotations):
            image = item["image_id"]
            if item["category_id"] not in labels:
                raise ValueError(
                    f"{self.path}: category ids {[item['category_id']]} of {names.get(image, image)} are not declared"
                )
            if not item.get("iscrowd", 0) and labels[item["category_id"]] is not None:
                rows.setdefault(image, []).append(row)
        return rows

    def boxes(self, rows: Iterable[int]) -> Float[Tensor, "b 4"]:
        """Return (x0, y0, x1, y1) in pixels of the annotations at these places."""
        boxes = torch.tensor([self.annotations[row]["bbox"] for row in rows], dtype=torch.float32).reshape(
            -1, 4
        )
        boxes[:, 2:] += boxes[:, :2]
        return boxes

    def bins(self, attribute: str) -> list[int]:
        """Return the pose bin of each annotation from 0, which the file counts from 1; -1 where nothing says it.

        Args:
            attribute: of the annotation, or else of its image; dots lead into entries of entries.

        Raises:
            ValueError: a bin that is no whole number from 1, or no bin at all.
        """
        where = f"{self.path}: target.bin_attribute={attribute!r}"
        of_image = {entry["id"]: _value(entry, attribute) for entry in self.images}
        bins = []
        for row, item in enumerate(self.annotations):
            value = _value(item, attribute)
            value = of_image.get(item["image_id"]) if value is None else value
            if value is not None and (type(value) is not int or value < 1):
                raise ValueError(
                    f"{where}: want a whole number from 1, annotations[{row}] or its image has {value!r}"
                )
            bins.append(-1 if value is None else value - 1)
        if all(b < 0 for b in bins):
            raise ValueError(f"{where}: no annotation and no image has it")
        return bins


def _value(entry: Mapping[str, Any], attribute: str) -> Any:
    value: Any = entry
    for key in attribute.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
