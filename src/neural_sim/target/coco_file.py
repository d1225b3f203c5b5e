"""Read and check COCO annotation files, for targets and for pictures on which a detector is tried."""

from __future__ import annotations

import logging
import math
import posixpath
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.pictures import Header, by
from neural_sim.target.classes import ClassMap
from neural_sim.target.other_formats import read_sections

_log = logging.getLogger(__name__)

REQUIRED: dict[str, tuple[str, ...]] = {
    "images": ("id", "file_name"),
    "categories": ("id", "name"),
    "annotations": ("image_id", "category_id", "bbox"),
}
OPTIONAL = ("width", "height", "iscrowd")
LARGEST = 1e9
"""More pixels than any picture has; also excludes numbers that are not finite."""
Entry = dict[str, Any]
COCO_KIND = ("category", "categories")
"""COCO's words for a class, and several."""


def is_number(value: object) -> bool:
    """Tell whether a JSON value is a finite number within the range of pixel coordinates."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def _check_id(value: object, where: str) -> None:
    whole = isinstance(value, float) and value.is_integer()  # 1.0 is 1
    if isinstance(value, bool) or not (isinstance(value, (int, str)) or whole):
        raise ValueError(f"{where}: want a whole number or a text, got {value!r:.80}")


def _check_file_name(value: object, where: str) -> None:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{where}: want the name of a file, got {value!r:.80}")


def _check_name(value: object, where: str) -> None:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"{where}: want a name, got {value!r:.80}")


def _check_box(value: object, where: str) -> None:
    numbers = value if isinstance(value, list) and all(map(is_number, value)) else []
    if len(numbers) != 4 or numbers[2] < 0 or numbers[3] < 0:
        raise ValueError(
            f"{where} must be x, y, width, height: four finite numbers, width and height not negative, "
            f"got {value!r:.80}"
        )


def _check_side(value: object, where: str) -> None:
    if value is not None and not (is_number(value) and value >= 0):  # pyright: ignore[reportOperatorIssue]
        raise ValueError(f"{where}: want a number of pixels, got {value!r:.80}")


def _check_crowd(value: object, where: str) -> None:
    if value not in (0, 1, None):
        raise ValueError(f"{where}: want 0 or 1, got {value!r:.80}")


CHECKS: dict[str, Callable[[object, str], None]] = {
    "id": _check_id, "image_id": _check_id, "category_id": _check_id, "file_name": _check_file_name,
    "name": _check_name, "bbox": _check_box, "width": _check_side, "height": _check_side, "iscrowd": _check_crowd,
}  # fmt: skip


def name_of(entry: Entry) -> str:
    """Return an image entry's ``file_name`` with ``/``, which tools on Windows do not write."""
    return posixpath.normpath(entry["file_name"].replace("\\", "/"))


def has_size(item: Entry) -> bool:
    """Tell whether an annotation's box has a width and a height."""
    return item["bbox"][2] > 0 and item["bbox"][3] > 0


def is_crowd(item: Entry) -> bool:
    """Tell whether an annotation marks several objects at once, so that its box is not that of an object."""
    return bool(item.get("iscrowd", 0))


def listed_size(entry: Entry) -> tuple[int | float, int | float] | None:
    """Return the width and height of an image entry; None unless it has both."""
    width, height = entry.get("width"), entry.get("height")
    return (width, height) if width and height else None  # tools that do not know it write 0


def refuse_size(entry: Entry, header: Header, where: str) -> None:
    """Raise ``ValueError`` for a picture whose displayed size is not that of its entry."""
    listed = listed_size(entry)
    if listed is not None and listed != header.shown:
        raise ValueError(
            f"{where} is listed with {by(listed)} pixels, but has {by(header.shown)}{header.turning}"
        )


def _upright(item: Entry) -> Entry:
    """Return an annotation, with the upright box around its box if CVAT's attribute ``rotation`` turns that."""
    attributes = item.get("attributes")
    angle = attributes.get("rotation") if isinstance(attributes, dict) else None
    if not is_number(angle) or not angle or item.get("segmentation"):  # a polygon's box is upright
        return item
    (x, y, width, height), turn = item["bbox"], math.radians(angle)
    across = abs(width * math.cos(turn)) + abs(height * math.sin(turn))
    down = abs(width * math.sin(turn)) + abs(height * math.cos(turn))
    box = [x + 0.5 * (width - across), y + 0.5 * (height - down), across, down]
    return {**item, "bbox": box}


@dataclass(frozen=True)
class CocoFile:
    """The sections of a file, with the keys of ``REQUIRED``; ``document`` is the whole content."""

    path: Path
    document: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> CocoFile:
        """Read and check a file.

        The log counts annotations of images that the file does not list, crowds, boxes of zero width or height,
        repeated boxes, and rotated boxes, which are replaced by the upright boxes around them.

        Raises:
            ValueError: the file is not JSON; a section or a key is missing; an id, a name or a box is invalid; an id or
                a file belongs to several images; or there are annotations, but none of a listed image.
        """
        document = read_sections(path, tuple(REQUIRED))
        for section, keys in REQUIRED.items():
            for number, entry in enumerate(document[section]):
                where = f"{path}: {section}[{number}]"
                missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
                if missing:
                    raise ValueError(f"{where} lacks {missing}")
                for key, check in CHECKS.items():
                    if key in entry and key in (*keys, *OPTIONAL):
                        check(entry[key], f"{where}.{key}")
        upright = [_upright(item) for item in document["annotations"]]
        file = cls(path, {**document, "annotations": upright})
        file._check_unique("images", "id", "file_name")
        file._check_unique("images", "file_name", "id")
        file._check_unique("categories", "id", "name")
        file._check_orphans()
        counts = {
            "crowds are left out (iscrowd=1, which CVAT also writes for masks)": sum(map(is_crowd, upright)),
            "boxes without a width or a height are left out": sum(not has_size(item) for item in upright),
            "boxes repeat an earlier one and are left out": len(file._repeated),
            "boxes are rotated (attributes.rotation) and replaced by the upright boxes around them":
                sum(a is not b for a, b in zip(upright, document["annotations"], strict=True)),
        }  # fmt: skip
        for what, count in counts.items():
            if count:
                _log.warning("%s: %d %s", path, count, what)
        return file

    @cached_property
    def _repeated(self) -> set[int]:
        """Indices of annotations that repeat an earlier one."""
        seen, repeated = set(), set()
        for row, item in enumerate(self.annotations):
            if is_crowd(item) or not has_size(item):
                continue  # it is left out, so that a box like it is no repetition
            said = (item["image_id"], item["category_id"], tuple(item["bbox"]))
            if said in seen:
                repeated.add(row)
            seen.add(said)
        return repeated

    def check_boxes(self, sizes: Mapping[Any, tuple[int, int]]) -> None:
        """Check that boxes lie on their pictures; the log counts those that reach beyond by more than a pixel.

        Args:
            sizes: width and height of the pictures by image id; boxes of other images are not checked.

        Raises:
            ValueError: boxes are fractions of the picture or corners, or none of them is on its picture.
        """
        rows = [
            row for row, item in enumerate(self.annotations) if item["image_id"] in sizes and has_size(item)
        ]
        if not rows:
            return
        boxes = self.boxes(rows)
        limits = torch.tensor([sizes[self.annotations[row]["image_id"]] for row in rows], dtype=torch.float32)
        beyond = ((boxes[:, :2] < -1.0) | (boxes[:, 2:] > limits + 1.0)).any(-1)
        first = rows[int(beyond.int().argmax())]
        example = f"such as annotations[{first}], {self.annotations[first]['bbox']}"
        wanted = "want x, y, width, height in pixels"
        if (boxes.abs() <= 1.0).all():
            raise ValueError(
                f"{self.path}: all boxes lie in the first pixel, {example}: {wanted}, not fractions"
            )
        if ((boxes[:, 2:] <= 0.0) | (boxes[:, :2] >= limits)).any(-1).all():
            raise ValueError(f"{self.path}: no box lies on its picture, {example}: {wanted}")
        # The boxes if their four numbers were two corners:
        corners = torch.cat([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], -1)
        fits = ((corners[:, 2:] > corners[:, :2]) & (corners[:, 2:] <= limits + 1.0)).all()
        if fits and 2 * int(beyond.sum()) > len(rows):
            raise ValueError(
                f"{self.path}: {int(beyond.sum())} of {len(rows)} boxes reach beyond their pictures, but none would if "
                f"its numbers were two corners, {example}: {wanted}"
            )
        if beyond.any():
            _log.warning(
                "%s: %d of %d boxes reach beyond their pictures and are clipped, %s",
                self.path, int(beyond.sum()), len(rows), example,
            )  # fmt: skip

    def _check_unique(self, section: str, key: str, other: str) -> None:
        """Raise ``ValueError`` for two entries with the same value of ``key``, or two spellings of one file's name."""
        first: dict[Any, int] = {}
        for number, entry in enumerate(self.document[section]):
            before = first.setdefault(name_of(entry) if key == "file_name" else entry[key], number)
            if before != number:
                raise ValueError(
                    f"{self.path}: {section}[{before}] and [{number}] ({self.document[section][before][other]!r} and "
                    f"{entry[other]!r}) have the same {key}, {entry[key]!r}: their annotations cannot be told apart"
                )

    def check_declared(self) -> None:
        """Raise ``ValueError`` for an annotation of an undeclared category."""
        declared = {entry["id"] for entry in self.document["categories"]}
        names = {entry["id"]: entry["file_name"] for entry in self.images}
        for number, item in enumerate(self.annotations):
            if item["category_id"] not in declared:
                shown = names.get(item["image_id"], item["image_id"])
                raise ValueError(
                    f"{self.path}: category ids {[item['category_id']]} of {shown} are not declared "
                    f"(annotations[{number}])"
                )

    def _check_orphans(self) -> None:
        """Warn about annotations whose images are not listed; raise ``ValueError`` if no image of any is."""
        ids = {entry["id"] for entry in self.images}
        strange = [number for number, item in enumerate(self.annotations) if item["image_id"] not in ids]
        if not strange:
            return
        example = f"annotations[{strange[0]}].image_id is {self.annotations[strange[0]]['image_id']!r}"
        if len(strange) < len(self.annotations):
            _log.warning(
                "%s: %d of %d annotations are of images that it does not list, such as %s",
                self.path, len(strange), len(self.annotations), example,
            )  # fmt: skip
        elif ids:
            raise ValueError(
                f"{self.path}: no annotation is of an image that it lists: {example}, images[0].id is "
                f"{self.images[0]['id']!r}"
            )

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
        return [str(entry["name"]) for entry in self.document["categories"]]

    @property
    def used_names(self) -> list[str]:
        """The names of the categories that have annotations."""
        used = {item["category_id"] for item in self.annotations}
        return [str(entry["name"]) for entry in self.document["categories"] if entry["id"] in used]

    def refuse_strange(self, classes: ClassMap, objects: Sequence[str]) -> None:
        """Refuse categories that are not objects; those without annotations are only logged.

        Raises:
            ValueError: as for ``ClassMap.refuse``.
        """
        used = self.used_names
        classes.refuse(used, objects)
        idle = [name for name in self.category_names if name not in used]
        strange = sorted(name for name in idle if classes.object_of(name) not in (None, *objects))
        if strange:
            _log.warning(
                "%s: categories %s are not objects and have no annotation: left out", self.path, strange
            )

    def by_id(self, labels: Mapping[str, int | None]) -> dict[Any, int | None]:
        """Return the labels of categories by their ids; ``labels`` has them by name."""
        return {entry["id"]: labels.get(str(entry["name"])) for entry in self.document["categories"]}

    @cached_property
    def usable(self) -> list[int]:
        """Indices of the annotations of single objects: no crowds, empty boxes or repetitions."""
        return [
            row for row, item in enumerate(self.annotations)
            if has_size(item) and not is_crowd(item) and row not in self._repeated
        ]  # fmt: skip

    def rows_by_image(self, labels: Mapping[Any, int | None]) -> dict[Any, list[int]]:
        """Return the indices of ``usable`` annotations of objects, by image id.

        Args:
            labels: label by category id, None for a category that is not an object.
        """
        rows: dict[Any, list[int]] = {}
        for row in self.usable:
            item = self.annotations[row]
            if labels[item["category_id"]] is not None:
                rows.setdefault(item["image_id"], []).append(row)
        return rows

    def boxes(self, rows: Iterable[int]) -> Float[Tensor, "b 4"]:
        """Return (x0, y0, x1, y1) in pixels for the annotations at these indices."""
        boxes = torch.tensor([self.annotations[row]["bbox"] for row in rows], dtype=torch.float32).reshape(
            -1, 4
        )
        boxes[:, 2:] += boxes[:, :2]
        return boxes

    def bins(self, attribute: str) -> list[int]:
        """Return the pose bin of each annotation, counted from 0 (the file counts from 1); -1 if it is unknown.

        Args:
            attribute: attribute of the annotation, or else of its image; dots lead into nested entries.

        Raises:
            ValueError: a bin is not a whole number of at least 1, or there is no bin at all.
        """
        where = f"{self.path}: target.bin_attribute={attribute!r}"
        of_image = {entry["id"]: _value(entry, attribute) for entry in self.images}
        bins = []
        for row, item in enumerate(self.annotations):
            value = _value(item, attribute)
            value = of_image.get(item["image_id"]) if value is None else value
            if value is not None and (type(value) is not int or value < 1):
                raise ValueError(
                    f"{where}: want a whole number of at least 1, annotations[{row}] or its image has {value!r}"
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
