"""A user's own target set in COCO form."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from neural_sim.objects.files import content_digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.assembling import Photo, assemble, large_enough
from neural_sim.target.base import Target
from neural_sim.target.bin_attribute import bins_of
from neural_sim.target.bin_matching import matching
from neural_sim.target.camera import camera_of_entry
from neural_sim.target.coco_file import labels_of_categories, read_coco
from neural_sim.target.groups import groups_of
from neural_sim.target.letterbox import letterbox
from neural_sim.target.near_duplicates import thumbnail
from neural_sim.target.parting import Looks, Parting
from neural_sim.target.split import check_fraction
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)
_Row = tuple[int, dict[str, Any]]  # an annotation with its place in the file


@dataclass(frozen=True)
class _Read:
    """A photograph, how many of its boxes were too small, and what it looks like."""

    photo: Photo
    dropped: int
    thumbnail: Tensor


@dataclass(frozen=True)
class CocoTarget(Target):
    """Photographs with a COCO ``annotations`` file, letterboxed to the detector's image size.

    Args:
        annotations: the JSON file.
        images: the folder its ``file_name`` entries start from; None: the file's own.
        categories: category name -> object name, null to leave a category out. Names not listed stand for
            themselves.
        val_fraction: fraction of the images for validation, which psi is learned from; the rest is scored once. With
            ``split_by`` as near to it as whole groups come, see :func:`neural_sim.target.split.split`.
        train_fraction: of the images that are not scored, for training (``training.real``), whole groups too; the
            others are for validation. None: all of them are.
        split_by: what images belong together and so lie in one part, as frames of one video must:
            ``attribute:<name>`` of the file's image entries, or a regular expression on ``file_name``, see
            :func:`neural_sim.target.groups.groups_of`. None: every image is its own group, and near-duplicates in both
            parts are warned of.
        limit: at most so many images, the first by id.
        minimum_side: boxes with a side shorter than this many pixels after resizing are dropped and counted.
        bin_attribute: the attribute of the file's annotations, or else of their image, that says the pose bin, counted
            from 1 as ``dominant`` of a distribution is; dots lead into entries of entries (``attributes.pose``). Boxes
            without one have no bin. None: no box has.
        match_bins: in both parts take those photographs alone with which each object's bins are distributed as the
            ``target`` of the first parameter with bins says, see :func:`neural_sim.target.bin_matching.matching`. Wants
            photographs of one object.

    Raises:
        ValueError: no such file, one that is not in COCO form, a number out of its range, ``match_bins`` without
            ``bin_attribute``, images that ``split_by`` does not put into two or more groups, or a bin that is none or
            that no entry has.
    """

    renders: ClassVar[bool] = False  # of the objects it takes the names alone
    annotations: str | Path
    images: str | Path | None = None
    categories: Mapping[str, str | None] | None = None
    val_fraction: float = 0.3
    train_fraction: float | None = None
    limit: int | None = None
    minimum_side: float = 2.0
    split_by: str | None = None
    bin_attribute: str | None = None
    match_bins: bool = False

    def __post_init__(self) -> None:
        if not self._file.is_file():
            raise ValueError(
                f"target.annotations: no such file: {self._file}; put a COCO file of labelled photographs there, "
                "or set target.annotations"
            )
        if self.match_bins and self.bin_attribute is None:
            raise ValueError(
                "target.match_bins: want target.bin_attribute, which says the pose bins, got null"
            )
        if not 0.0 < self.val_fraction < 1.0:
            raise ValueError(f"target.val_fraction must lie in (0, 1), got {self.val_fraction}")
        check_fraction(self.train_fraction)
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"target.limit must be at least 1 or null, got {self.limit}")
        if not self._entries:
            raise ValueError(f"{self._file}: holds no images")
        _ = self._groups, self._bins  # refused here rather than after the fields are fitted

    @property
    def _file(self) -> Path:
        return Path(self.annotations).expanduser()

    @property
    def _folder(self) -> Path:
        return self._file.parent if self.images is None else Path(self.images).expanduser()

    @cached_property
    def _document(self) -> dict[str, Any]:
        return read_coco(self._file)

    @cached_property
    def _entries(self) -> list[dict[str, Any]]:
        return sorted(self._document["images"], key=lambda entry: entry["id"])[: self.limit]

    @cached_property
    def _groups(self) -> Sequence[str | int]:
        """The group of each entry, which the split keeps together."""
        if self.split_by is None:
            return range(len(self._entries))
        return groups_of(self._entries, self.split_by, self._file)

    @cached_property
    def _bins(self) -> list[int] | None:
        """The pose bin of each annotation, from 0, -1 without one."""
        if self.bin_attribute is None:
            return None
        return bins_of(
            self._document["annotations"], self._document["images"], self.bin_attribute, self._file
        )

    @cached_property
    def _digest(self) -> str:
        names = [str(entry["file_name"]) for entry in self._document["images"]]
        return content_digest({"": self._file, **{name: self._folder / name for name in names}})

    @property
    def trains(self) -> bool:
        """Whether some of the images are for training."""
        return self.train_fraction is not None

    def camera(self) -> PinholeCamera:
        """Of the file's entry ``camera``, see :func:`neural_sim.target.camera.camera_of_entry`.

        Raises:
            ValueError: a file without one, or photographs whose listed size is another one.
        """
        if "camera" not in self._document:
            raise ValueError(
                f"{self._file}: camera=from_target wants an entry 'camera' with width, height, fx, fy, cx, cy"
            )
        camera = camera_of_entry(self._document["camera"], f"{self._file}: camera")
        size = {"width": camera.width, "height": camera.height}
        for entry in self._entries:
            other = {key: entry[key] for key in size if entry.get(key, size[key]) != size[key]}
            if other:
                raise ValueError(f"{self._file}: {entry['file_name']} has {other}, its camera {size}")
        return camera

    def digest(self) -> str:
        """SHA-256 of the contents of annotations and photographs, for store keys."""
        return self._digest

    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """``val``, ``test`` and any ``train``, with the objects' names as classes; takes the arguments of every target
        set.
        """
        first = next(iter(distribution.binned), None)
        if self._bins is not None and first is not None and max(self._bins) >= first.bins:
            raise ValueError(
                f"{self._file}: target.bin_attribute={self.bin_attribute!r}: bin {max(self._bins) + 1} of an "
                f"annotation is beyond the {first.bins} of {first.name}"
            )
        read = self._photos(list(objects), camera.height, camera.width)
        generator = torch.Generator().manual_seed(seed)
        looks = [
            Looks(str(entry["file_name"]), group, item.photo.image, item.thumbnail)
            for entry, group, item in zip(self._entries, self._groups, read, strict=True)
        ]
        parts = Parting(self.val_fraction, self.train_fraction, self.split_by, self._file).parts(
            looks, generator
        )
        images = assemble([item.photo for item in read])
        chosen = {part: torch.tensor(rows) for part, rows in parts.items()}
        if self.match_bins:
            if first is None:
                raise ValueError("target.match_bins: want a parameter with bins, such as parameter=[pose]")
            goals = {name: first.probabilities("target", name) for name in objects}
            where = f"{self._file}: target.match_bins"
            chosen = {
                part: matching(images, rows, goals, generator, f"{where}, {part}")
                for part, rows in chosen.items()
            }
            counts = ", ".join(f"{len(rows)} of {part}" for part, rows in chosen.items())
            _log.info("%s takes %s", where, counts)
        return {part: images.select(rows) for part, rows in chosen.items()}

    def load(self, class_names: Sequence[str], height: int, width: int) -> LabelledImages:
        """All images; labels are positions in ``class_names``. Crowd annotations are left out, boxes clipped.

        Raises:
            ValueError: a category that is no class, an image that is missing or unreadable.
        """
        return assemble([item.photo for item in self._photos(class_names, height, width)])

    def _photos(self, class_names: Sequence[str], height: int, width: int) -> list[_Read]:
        labels = labels_of_categories(
            self._document["categories"], self.categories, class_names, self._file, "target.categories"
        )
        by_image: dict[Any, list[_Row]] = {entry["id"]: [] for entry in self._entries}
        for row, item in enumerate(self._document["annotations"]):
            if not item.get("iscrowd", 0) and item["image_id"] in by_image:
                by_image[item["image_id"]].append((row, item))
        read = [self._photo(e, by_image[e["id"]], labels, height, width) for e in self._entries]
        dropped = sum(item.dropped for item in read)
        if dropped:
            _log.warning("%s: %d boxes shorter than %g px dropped", self._file, dropped, self.minimum_side)
        return read

    def _photo(
        self,
        entry: dict[str, Any],
        annotations: list[_Row],
        labels: dict[Any, int | None],
        height: int,
        width: int,
    ) -> _Read:
        path = self._folder / entry["file_name"]
        try:
            with Image.open(path) as file:
                image, placing = letterbox(file, height, width)
        except (OSError, UnidentifiedImageError) as error:
            raise ValueError(f"{path} (named in {self._file}): not a readable image ({error})") from error
        unknown = {item["category_id"] for _, item in annotations} - set(labels)
        if unknown:
            raise ValueError(f"{self._file}: category ids {sorted(unknown)} of {path.name} are not declared")
        kept = [(row, item) for row, item in annotations if labels[item["category_id"]] is not None]
        corners = torch.tensor([item["bbox"] for _, item in kept], dtype=torch.float32).reshape(-1, 4)
        corners[:, 2:] += corners[:, :2]
        boxes = placing.boxes(corners)
        large = large_enough(boxes, self.minimum_side)
        classes = torch.tensor([labels[item["category_id"]] for _, item in kept], dtype=torch.long)
        bins = (
            None
            if self._bins is None
            else torch.tensor([self._bins[row] for row, _ in kept], dtype=torch.long)[large]
        )
        inside = image[:, placing.top :, placing.left :][:, : placing.inner_height, : placing.inner_width]
        photo = Photo(image, boxes[large], classes[large], bins)
        return _Read(photo, int((~large).sum()), thumbnail(inside))
