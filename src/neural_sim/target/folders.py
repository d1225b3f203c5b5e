"""The target set of a classifier: photographs in one folder for each class, as in ImageNet and ObjectNet."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import torch
from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.pictures import check_headers, without_leftovers
from neural_sim.ranges import NonNegativeInt, validated
from neural_sim.target.base import AnnotatedPhotographs
from neural_sim.target.classes import ClassMap
from neural_sim.target.photographs import PhotoFiles, Photograph
from neural_sim.target.split import evenly, groups_of


@validated
@dataclass(frozen=True)
class FolderTarget(AnnotatedPhotographs):
    """Photographs ``<root>/<class>/...`` at any depth. They have no boxes: an image's box is the whole photograph.

    ``split_by`` is searched for in ``<class>/<file>``. If a class has more photographs than ``limit``, evenly spaced
    ones by name are taken. With ``unmatched=leave_out`` and ``classes``, every folder that is not listed is skipped
    unread.

    Args:
        root: the folder that holds the classes' folders.
        classes: folder name -> object name, null to leave a folder out. Names not listed are the names of their
            objects.
        border: number of pixels to cut off each side of every photograph, such as 2 for ObjectNet's frame.

    See ``Photographs`` for the other arguments; ``minimum_side`` has no effect.

    Raises:
        ValueError: there is no such folder, it has no folders, one that is read has no photographs, ``classes`` names a
            folder that does not exist, a number is out of its range, or ``split_by`` gives fewer than two groups.
    """

    boxed: ClassVar[bool] = False
    root: str | Path
    classes: Mapping[str, str | None] | None = None
    border: NonNegativeInt = 0

    def __post_init__(self) -> None:
        if not self.source.is_dir():
            raise ValueError(
                f"target.root: no such folder: {self.source}; put photographs there, a folder for each class, or set "
                "target.root"
            )
        if not self._folders:
            raise ValueError(f"target.root: {self.source} has no folders, want one for each class")
        self._classes.check_listed(self._folders)
        check_headers(self.files().values(), "target.root")
        _ = self._groups  # refused here rather than after the fields are fitted

    @property
    @override
    def source(self) -> Path:
        return Path(self.root).expanduser()

    @property
    def _classes(self) -> ClassMap:
        return ClassMap(self.classes, self.source, kind=("folder", "folders"), unmatched=self.unmatched)

    @cached_property
    def _folders(self) -> dict[str, Path]:
        folders = [path for path in sorted(self.source.iterdir()) if path.is_dir()]
        return {path.name: path for path in without_leftovers(folders, self.source)}

    @property
    def _read(self) -> list[str]:
        """The folders that may be objects."""
        only_listed = bool(self.classes) and self.unmatched == "leave_out"
        folders = self.classes or {} if only_listed else self._folders
        return [
            name for name in self._folders if name in folders and self._classes.object_of(name) is not None
        ]

    def _taken(self, folders: Collection[str]) -> list[tuple[str, Path]]:
        """List each photograph of these folders, with its folder."""
        taken = []
        for folder in folders:
            paths = PhotoFiles(str(self._folders[folder]), "target.root").paths
            taken += [(folder, path) for path in evenly(paths, self.limit)]
        return taken

    @cached_property
    def _groups(self) -> dict[str, str]:
        """The group of each photograph by name, for folders that may be objects."""
        names = list(self.files())
        groups = names if self.split_by is None else groups_of(names, self.split_by, self.source)
        return dict(zip(names, groups, strict=True))

    def _name(self, path: Path) -> str:
        return path.relative_to(self.source).as_posix()

    @override
    def files(self) -> dict[str, Path]:
        return {self._name(path): path for _, path in self._taken(self._read)}

    @override
    def photographs(
        self, objects: Sequence[str], distribution: SceneDistribution | None = None
    ) -> list[Photograph]:
        self._classes.refuse(self._read, objects)
        labels = self._classes.labels(self._read, objects)
        if not labels:
            raise ValueError(f"{self.source}: no folder is one of the objects {list(objects)}")
        return [
            Photograph(
                path,
                torch.tensor([labels[folder]]),
                name=self._name(path),
                group=self._groups[self._name(path)],
                where=f"target.root: {path}",
                border=self.border,
            )
            for folder, path in self._taken(labels)
        ]
