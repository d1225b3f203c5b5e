"""Photographs in one folder per class, as ImageNet and ObjectNet have them: the target set of a classifier."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, get_args

import torch
from PIL import ImageOps
from torch import Tensor

from neural_sim.checks import at_least
from neural_sim.objects.files import content_digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.assembling import Photo, assemble
from neural_sim.target.base import Target
from neural_sim.target.groups import ATTRIBUTE, groups_of
from neural_sim.target.letterbox import letterbox
from neural_sim.target.near_duplicates import thumbnail
from neural_sim.target.parting import Looks, Parting
from neural_sim.target.photo_files import PhotoFiles
from neural_sim.target.split import check_fraction, evenly
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)

Unmatched = Literal["refuse", "leave_out"]


@dataclass(frozen=True)
class FolderTarget(Target):
    """Photographs ``<root>/<class>/...`` at any depth, letterboxed to the classifier's image size. They have no boxes:
    an image's box is the whole photograph.

    Args:
        root: the folder of the classes' folders.
        classes: folder's name -> object name, null to leave a folder out. Names not listed stand for themselves.
        unmatched: what becomes of a folder that is no object: ``refuse`` the data set, or ``leave_out`` the folder, and
            with ``classes`` every folder that these do not list, unread.
        border: pixels that are cut off each side of every photograph, such as ObjectNet's frame of 2.
        val_fraction: fraction of the photographs for validation, which psi is learned from; the rest is scored once.
        train_fraction: of the photographs that are not scored, for training (``training.real``); None: none.
        split_by: a regular expression on ``<class>/<file>`` that says what belongs together, see
            :func:`neural_sim.target.groups.groups_of`. None: every photograph is its own group, and near-duplicates in
            two parts are warned of.
        limit: at most so many photographs of each class, evenly spaced by name; None: all.

    Raises:
        ValueError: no such folder, no folder with photographs in it, one that ``classes`` names and that is not there,
            a number out of its range, or photographs that ``split_by`` does not put into two or more groups.
    """

    renders: ClassVar[bool] = False  # of the objects it takes the names alone
    boxed: ClassVar[bool] = False
    root: str | Path
    classes: Mapping[str, str | None] | None = None
    unmatched: Unmatched = "refuse"
    border: int = 0
    val_fraction: float = 0.3
    train_fraction: float | None = None
    split_by: str | None = None
    limit: int | None = None

    def __post_init__(self) -> None:
        if not self._root.is_dir():
            raise ValueError(
                f"target.root: no such folder: {self._root}; put photographs there, a folder for each class, or set "
                "target.root"
            )
        if not 0.0 < self.val_fraction < 1.0:
            raise ValueError(f"target.val_fraction must lie in (0, 1), got {self.val_fraction}")
        check_fraction(self.train_fraction)
        at_least("target", 0, border=self.border)
        if self.limit is not None:
            at_least("target", 1, limit=self.limit)
        if self.unmatched not in get_args(Unmatched):
            raise ValueError(f"target.unmatched must be one of {get_args(Unmatched)}, got {self.unmatched!r}")
        if not self._folders:
            raise ValueError(f"target.root: {self._root} has no folders, want one for each class")
        absent = sorted(set(self.classes or {}) - set(self._folders))
        if absent:
            raise ValueError(
                f"target.classes: {absent} are no folders of {self._root}, there are {list(self._folders)}"
            )
        if self.split_by is not None and self.split_by.startswith(ATTRIBUTE):
            raise ValueError(f"target.split_by: want a regular expression or null, got {self.split_by!r}")
        _ = self._groups  # refused here rather than after the fields are fitted

    @property
    def _root(self) -> Path:
        return Path(self.root).expanduser()

    @cached_property
    def _folders(self) -> dict[str, Path]:
        return {path.name: path for path in sorted(self._root.iterdir()) if path.is_dir()}

    @property
    def _named(self) -> dict[str, str]:
        """Folder -> object name, without those that ``classes`` leaves out."""
        classes, all_listed = self.classes or {}, bool(self.classes) and self.unmatched == "leave_out"
        folders = [folder for folder in self._folders if folder in classes or not all_listed]
        named = {folder: classes.get(folder, folder) for folder in folders}
        return {folder: name for folder, name in named.items() if name is not None}

    def _taken(self, folders: Sequence[str]) -> list[tuple[str, Path]]:
        """Each photograph of these folders, with its folder."""
        taken = []
        for folder in folders:
            paths = PhotoFiles(str(self._folders[folder]), "target.root").paths
            taken += [(folder, path) for path in evenly(paths, self.limit)]
        return taken

    @cached_property
    def _groups(self) -> dict[str, str]:
        """The group of each photograph by its name, of those in folders that may be objects."""
        entries = [{"file_name": self._name(path)} for _, path in self._taken(list(self._named))]
        names = [entry["file_name"] for entry in entries]
        groups = names if self.split_by is None else groups_of(entries, self.split_by, self._root)
        return dict(zip(names, groups, strict=True))

    def _name(self, path: Path) -> str:
        return path.relative_to(self._root).as_posix()

    @property
    def trains(self) -> bool:
        """Whether some of the photographs are for training."""
        return self.train_fraction is not None

    @cached_property
    def _digest(self) -> str:
        return content_digest({self._name(path): path for _, path in self._taken(list(self._named))})

    def digest(self) -> str:
        """SHA-256 of the names and contents of the photographs, for store keys."""
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

        Raises:
            ValueError: a folder that is no object where that is refused, none that is one, or a photograph that cannot
                be read.
        """
        photos, looks = self._read(list(objects), camera.height, camera.width)
        parting = Parting(self.val_fraction, self.train_fraction, self.split_by, self._root)
        parts = parting.parts(looks, torch.Generator().manual_seed(seed))
        images = assemble(photos)
        return {part: images.select(torch.tensor(rows)) for part, rows in parts.items()}

    def _read(self, class_names: Sequence[str], height: int, width: int) -> tuple[list[Photo], list[Looks]]:
        labels = self._labels(class_names)
        photos, looks = [], []
        for folder, path in self._taken(list(labels)):
            image, box, small = self._photo(path, height, width)
            photos.append(Photo(image, box, torch.tensor([labels[folder]])))
            looks.append(Looks(self._name(path), self._groups[self._name(path)], image, small))
        return photos, looks

    def _labels(self, class_names: Sequence[str]) -> dict[str, int]:
        """Folder -> label, of the folders that are objects."""
        strange = sorted(folder for folder, name in self._named.items() if name not in class_names)
        if strange and self.unmatched == "refuse":
            raise ValueError(
                f"{self._root}: folders {strange} are no objects; objects are {list(class_names)}. Map them by "
                "target.classes, {folder: object} or {folder: null}, or set target.unmatched=leave_out"
            )
        labels = {
            folder: class_names.index(name) for folder, name in self._named.items() if name in class_names
        }
        if not labels:
            raise ValueError(f"{self._root}: no folder is one of the objects {list(class_names)}")
        for name in sorted(set(class_names) - {self._named[folder] for folder in labels}):
            _log.warning("%s: no folder for object %s, which gets no score", self._root, name)
        return labels

    def _photo(self, path: Path, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
        """The letterboxed photograph, the box [1, 4] that it fills, and its thumbnail."""
        photo = PhotoFiles(str(path), "target.root").read(path)
        if min(photo.size) <= 2 * self.border:
            raise ValueError(f"target.border: {self.border} leaves nothing of {path}, of {photo.size} pixels")
        image, placing = letterbox(ImageOps.crop(photo, self.border), height, width)
        whole = torch.tensor([[0.0, 0.0, placing.width, placing.height]])
        inside = image[:, placing.top :, placing.left :][:, : placing.inner_height, : placing.inner_width]
        return image, placing.boxes(whole), thumbnail(inside)
