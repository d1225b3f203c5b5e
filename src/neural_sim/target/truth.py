"""Ground truth of photographs on which a detector is tried, in the photographs' own pixels."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.pictures import read_header
from neural_sim.target.classes import ClassMap
from neural_sim.target.coco_file import COCO_KIND, CocoFile, name_of, refuse_size
from neural_sim.target.other_formats import missing_file
from neural_sim.target.photographs import Boxes, PhotoFiles, padded
from neural_sim.types import LabelledImages

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Truth:
    """Ground truth from the COCO file ``path``, matched to a detector's classes and to ``photos``.

    ``categories`` maps the file's category names to class names, null to leave one out. A photograph's entry is the one
    whose ``file_name`` is its path below the photographs' folder or the file's folder, or else the only one with its
    name.

    Raises:
        ValueError: there is no such file, it is not in COCO form, a category has no class, no photograph has an entry,
            or an entry states another size.
    """

    path: Path
    categories: Mapping[str, str | None] | None
    class_names: Sequence[str]
    photos: PhotoFiles

    def __post_init__(self) -> None:
        if not self.path.is_file():
            raise ValueError(f"predict.annotations: {missing_file(self.path)}")
        _ = self.labels
        self._file.check_declared()
        found, total = len(self.entries), len(self.photos.paths)
        if not found:
            raise ValueError(
                f"predict.annotations: {self.path} has no entry for any of the {total} pictures of "
                f"predict.images, such as {self.photos.name(self.photos.paths[0])}"
            )
        sizes = {}
        for path, entry in self.entries.items():
            header = read_header(path)
            refuse_size(entry, header, f"predict.annotations: {self.path}: {path}")
            sizes[entry["id"]] = header.shown
        try:
            self._file.check_boxes(sizes)
        except ValueError as error:
            raise ValueError(f"predict.annotations: {error}") from error
        if found < total:
            _log.warning(
                "%s: no entry for %d of %d pictures; they are not scored", self.path, total - found, total
            )
        if found < len(self._file.images):
            missing = len(self._file.images) - found
            _log.warning(
                "%s: %d of its images are not among the pictures; they are not scored", self.path, missing
            )

    @cached_property
    def _file(self) -> CocoFile:
        try:
            return CocoFile.read(self.path)
        except ValueError as error:
            raise ValueError(f"predict.annotations: {error}") from error

    @cached_property
    def labels(self) -> dict[Any, int | None]:
        """Class index by category id; None for a category that is left out."""
        names = self._file.category_names
        source = f"predict.annotations: {self.path}"
        classes = ClassMap(self.categories, source, "predict.categories", COCO_KIND, None)
        classes.check_listed(names)
        self._file.refuse_strange(classes, self.class_names)
        return self._file.by_id(classes.labels(names, self.class_names))

    @cached_property
    def category_ids(self) -> dict[int, Any]:
        """Category id by class index, the first one that maps to the class. Classes without one are missing."""
        found: dict[int, Any] = {}
        for id, label in self.labels.items():
            if label is not None:
                found.setdefault(label, id)
        return found

    @cached_property
    def entries(self) -> dict[Path, dict[str, Any]]:
        """The file's image entries by photograph."""
        by_name = {name_of(entry): entry for entry in self._file.images}
        by_last: dict[str, list[dict[str, Any]]] = {}
        for name, entry in by_name.items():
            by_last.setdefault(Path(name).name, []).append(entry)
        last_names = Counter(path.name for path in self.photos.paths)
        found = {}
        for path in self.photos.paths:
            entry = by_name.get(self.photos.name(path)) or by_name.get(_below(path, self.path.parent))
            same = by_last.get(path.name, [])
            if entry is None and len(same) == 1 and last_names[path.name] == 1:
                entry = same[0]
            if entry is not None:
                found[path] = entry
        return found

    @cached_property
    def _rows(self) -> dict[Any, list[int]]:
        """Indices of annotations by image id."""
        return self._file.rows_by_image(self.labels)

    def boxes(self, path: Path) -> tuple[Float[Tensor, "b 4"], Int[Tensor, "b"]]:
        """Return (x0, y0, x1, y1) in pixels, and class indices, of a photograph with an entry, without crowds."""
        entry = self.entries[path]
        rows = self._rows.get(entry["id"], [])
        labels = [self.labels[self._file.annotations[row]["category_id"]] for row in rows]
        return self._file.boxes(rows), torch.tensor(labels, dtype=torch.long)


def without_pixels(truths: Sequence[tuple[Tensor, Tensor]]) -> LabelledImages:
    """Return boxes and labels of several photographs as a set for scoring detections, which needs no pixels."""
    return padded(torch.zeros(len(truths), 3, 1, 1), [Boxes(*truth) for truth in truths])


def _below(path: Path, folder: Path) -> str:
    """Return a path below a folder with ``/``; empty if it lies elsewhere."""
    path, folder = path.resolve(), folder.resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else ""
