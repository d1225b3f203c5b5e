"""A user's own target set as a COCO file."""

from __future__ import annotations

import logging
import os
import posixpath
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor
from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.pictures import by, read_header, refuse_mode
from neural_sim.ranges import validated
from neural_sim.target.base import AnnotatedPhotographs
from neural_sim.target.camera import camera_of_entry
from neural_sim.target.classes import ClassMap
from neural_sim.target.coco_file import COCO_KIND, CocoFile, Entry, listed_size, name_of, refuse_size
from neural_sim.target.other_formats import missing_file
from neural_sim.target.photographs import Photograph
from neural_sim.target.pose_bins import matching
from neural_sim.target.split import groups_of
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)


@validated
@dataclass(frozen=True)
class CocoTarget(AnnotatedPhotographs):
    """Photographs with a COCO ``annotations`` file.

    Crowd annotations are left out, and boxes are clipped to the image. ``split_by`` may also be ``attribute:<name>``,
    an attribute of the file's image entries. If there are more images than ``limit``, the first by id are taken.

    Args:
        annotations: the JSON file.
        images: folder to which its ``file_name`` entries are relative; None: the file's own folder.
        categories: category name -> object name, null to leave a category out. Names not listed are the names of their
            objects.
        bin_attribute: attribute that holds the pose bin, counted from 1 as in ``dominant`` of a distribution. It is
            read from the annotation or, if that lacks it, from the annotation's image; dots lead into nested entries
            (``attributes.pose``). Boxes without it have no bin. None: no box has one.
        match_bins: in every part, choose photographs such that each object's bins follow the ``target`` of the first
            parameter with bins, see ``neural_sim.target.pose_bins.matching``. Needs photographs of a single object
            each.

    See ``Photographs`` for the other arguments.

    Raises:
        ValueError: there is no such file, it is not in COCO form or has no usable box, a number is out of its range,
            ``match_bins`` is set without ``bin_attribute``, ``split_by`` gives fewer than two groups, a category is not
            in the file, or a bin is invalid or no entry has one.
    """

    annotations: str | Path
    images: str | Path | None = None
    categories: Mapping[str, str | None] | None = None
    bin_attribute: str | None = None
    match_bins: bool = False

    def __post_init__(self) -> None:
        if not self.source.is_file():
            raise ValueError(
                f"target.annotations: {missing_file(self.source)}; put a COCO file of labelled photographs there, "
                "or set target.annotations"
            )
        if self.match_bins and self.bin_attribute is None:
            raise ValueError(
                "target.match_bins: want target.bin_attribute, the attribute that holds the pose bin, got null"
            )
        if not self._entries:
            raise ValueError(f"{self.source}: has no images")
        if not self._coco.usable:
            raise ValueError(
                f"{self.source}: has no usable box (crowds and boxes without a side do not count)"
            )
        self._classes.check_listed(self._coco.category_names)
        self._coco.check_declared()
        self._coco.check_boxes(self._sizes)
        _ = self._groups, self._bins  # refused here rather than after the fields are fitted

    @property
    @override
    def source(self) -> Path:
        return Path(self.annotations).expanduser()

    @property
    def _folder(self) -> Path:
        return self.source.parent if self.images is None else Path(self.images).expanduser()

    @property
    def _classes(self) -> ClassMap:
        return ClassMap(self.categories, self.source, "target.categories", COCO_KIND, self.unmatched)

    @cached_property
    def _coco(self) -> CocoFile:
        return CocoFile.read(self.source)

    @cached_property
    def _entries(self) -> list[Entry]:
        return sorted(self._coco.images, key=_order)[: self.limit]

    @cached_property
    def _groups(self) -> Sequence[str | int]:
        """The group of each entry."""
        if self.split_by is None:
            return range(len(self._entries))
        names = [name_of(entry) for entry in self._entries]
        return groups_of(names, self.split_by, self.source, self._entries)

    @cached_property
    def _bins(self) -> list[int] | None:
        """The pose bin of each annotation, counted from 0; -1 if it has none."""
        return None if self.bin_attribute is None else self._coco.bins(self.bin_attribute)

    @override
    def files(self) -> dict[str, Path]:
        return {"": self.source, **{name_of(entry): self._path(entry) for entry in self._coco.images}}

    @cached_property
    def _roots(self) -> list[Path]:
        """Folders to which file names may be relative.

        ``images`` if it is set; otherwise the annotation file's folder and a folder named ``images`` in it or next to
        it.
        """
        here = self._folder
        return [here] if self.images is not None else [here, here / "images", here.parent / "images"]

    @cached_property
    def _last_names(self) -> Counter[str]:
        return Counter(_last(entry) for entry in self._coco.images)

    def _path(self, entry: Entry) -> Path:
        """Find an image's file by its name: as written, with ``/`` as separator, or in NFC or NFD.

        If there is no such file (the name may have other folders, or be a URL), it is the file with the last part of
        the name, unless another image has the same last part.

        Raises:
            ValueError: the name leads out of the folder.
        """
        names = _spellings(entry)
        folder = os.path.abspath(self._folder)
        for name in names:
            if os.path.commonpath([folder, os.path.abspath(self._folder / name)]) != folder:
                raise ValueError(
                    f"{self.source}: file_name {entry['file_name']!r} of image {entry['id']!r} leads out of {folder}; "
                    "want names that start from target.images, or from the file's folder where that is null"
                )
        if self._last_names[_last(entry)] == 1:
            names.append(_last(entry))
        paths = [root / name for name in names for root in self._roots]
        return next((path for path in paths if path.is_file()), paths[len(self._roots)])

    def _where(self, entry: Entry) -> str:
        return f"{self._path(entry)} (named in {self.source})"

    @cached_property
    def _sizes(self) -> dict[Any, tuple[int, int]]:
        """Width and height of the upright pictures, by image id.

        Raises:
            ValueError: a picture's header cannot be read, or shows another size than listed.
        """
        unsized, moved, sizes = [], [], {}
        for entry in self._entries:
            path, where = self._path(entry), self._where(entry)
            if not path.is_file():
                raise ValueError(
                    f"{where}: not a readable image (no such file; target.images is the folder that file names start "
                    "from)"
                )
            header = read_header(path, where)
            refuse_mode(header.mode, header.format, where)
            refuse_size(entry, header, where)
            sizes[entry["id"]] = header.shown
            if path not in [self._folder / name for name in _spellings(entry)]:
                moved.append(f"{path} for {entry['file_name']!r}")
            if header.orientation > 1 and listed_size(entry) is None:
                unsized.append(path)
        if moved:
            _log.warning(
                "%s: %d pictures are not where file_name says and were found elsewhere, such as %s",
                self.source, len(moved), moved[0],
            )  # fmt: skip
        if unsized:
            _log.warning(
                "%s: %d photographs are turned by EXIF and listed without width and height, such as %s; their boxes "
                "are taken to be in the upright pictures", self.source, len(unsized), unsized[0],
            )  # fmt: skip
        return sizes

    @override
    def camera(self) -> PinholeCamera:
        """Return the camera of the file's entry ``camera``, see ``neural_sim.target.camera.camera_of_entry``.

        Raises:
            ValueError: the file has no camera, or photographs have another size.
        """
        entry = self._coco.document.get("camera")
        if entry is None:
            raise ValueError(
                f"{self.source}: camera=from_target needs an entry 'camera' with width, height, fx, fy, cx, cy"
            )
        camera = camera_of_entry(entry, f"{self.source}: camera")
        size = camera.width, camera.height
        for image in self._entries:
            shown = self._sizes[image["id"]]
            if shown != size:
                raise ValueError(
                    f"{self.source}: {image['file_name']} has {by(shown)} pixels, its camera {by(size)}"
                )
        return camera

    @override
    def photographs(
        self, objects: Sequence[str], distribution: SceneDistribution | None = None
    ) -> list[Photograph]:
        self._check_bins(distribution)
        names = self._coco.category_names
        self._coco.refuse_strange(self._classes, objects)
        labels = self._coco.by_id(self._classes.labels(names, objects))
        rows = self._coco.rows_by_image(labels)
        self._log_left_out(names, objects)
        return [
            self._photograph(entry, group, rows.get(entry["id"], []), labels)
            for entry, group in zip(self._entries, self._groups, strict=True)
        ]

    def _photograph(
        self, entry: Entry, group: str | int, rows: Sequence[int], labels: Mapping[Any, int | None]
    ) -> Photograph:
        categories = [self._coco.annotations[row]["category_id"] for row in rows]
        bins = (
            None if self._bins is None else torch.tensor([self._bins[row] for row in rows], dtype=torch.long)
        )
        return Photograph(
            self._path(entry),
            torch.tensor([labels[category] for category in categories], dtype=torch.long),
            self._coco.boxes(rows),
            bins,
            name=name_of(entry),
            group=group,
            where=self._where(entry),
        )

    def _check_bins(self, distribution: SceneDistribution | None) -> None:
        """Raise ``ValueError`` for bins that the first factor with bins does not have."""
        first = None if distribution is None else next(iter(distribution.binned), None)
        if self._bins is not None and first is not None and max(self._bins) >= first.bins:
            raise ValueError(
                f"{self.source}: target.bin_attribute={self.bin_attribute!r}: bin {max(self._bins) + 1} of an "
                f"annotation is beyond the {first.bins} of {first.name}"
            )

    def _log_left_out(self, names: Sequence[str], objects: Sequence[str]) -> None:
        """Log the number of boxes of categories that are not objects, which ``unmatched=leave_out`` drops."""
        classes = self._classes
        strange = {name for name in names if classes.object_of(name) not in (None, *objects)}
        known = {entry["id"]: str(entry["name"]) for entry in self._coco.document["categories"]}
        items = (self._coco.annotations[row] for row in self._coco.usable)
        counts = Counter(known[item["category_id"]] for item in items if item["image_id"] in self._sizes)
        left_out = {name: counts[name] for name in sorted(strange) if counts[name]}
        if left_out:
            _log.info("%s: boxes of categories that are not objects left out: %s", self.source, left_out)

    @override
    def choose(
        self,
        images: LabelledImages,
        rows: Mapping[str, Int[Tensor, "_"]],
        objects: Sequence[str],
        distribution: SceneDistribution,
        generator: torch.Generator,
    ) -> Mapping[str, Int[Tensor, "_"]]:
        if not self.match_bins:
            return rows
        first = next(iter(distribution.binned), None)
        if first is None:
            raise ValueError("target.match_bins: want a parameter with bins, such as parameter=[pose]")
        goals = {name: first.probabilities("target", name) for name in objects}
        where = f"{self.source}: target.match_bins"
        chosen = {
            part: matching(images, own, goals, generator, f"{where}, {part}") for part, own in rows.items()
        }
        counts = ", ".join(f"{len(own)} of {part}" for part, own in chosen.items())
        _log.info("%s takes %s", where, counts)
        return chosen


def _spellings(entry: Entry) -> list[str]:
    """Return an image's name as it is written, with ``/``, and in both of Unicode's forms."""
    name = name_of(entry)
    return [entry["file_name"], name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]


def _last(entry: Entry) -> str:
    return posixpath.basename(name_of(entry))


def _order(entry: Entry) -> tuple[bool, Any]:
    """Return the key by which entries are sorted: numbers by value, then texts."""
    return isinstance(entry["id"], str), entry["id"]
