"""Photographs that a user names: a folder, a glob or one file."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from neural_sim.synthesis.background import PHOTO_SUFFIXES


@dataclass(frozen=True)
class PhotoFiles:
    """The photographs under a folder, at any depth, or those that a glob (``**`` goes down) or a path names.

    Args:
        where: the folder, glob or path; ``~`` is the user's home.
        key: the setting that it comes from, for messages.

    Raises:
        ValueError: nothing of that name, or no photograph there.
    """

    where: str
    key: str

    def __post_init__(self) -> None:
        if not self.paths:
            if self._folder.is_dir():
                raise ValueError(f"{self.key}: no picture ({', '.join(PHOTO_SUFFIXES)}) in {self.where}")
            raise ValueError(
                f"{self.key}: want a folder of pictures, a glob or a picture, got {self.where}, "
                + ("which no file matches" if glob.has_magic(self.where) else "which does not exist")
            )

    @property
    def _folder(self) -> Path:
        return Path(self.where).expanduser()

    @cached_property
    def paths(self) -> Sequence[Path]:
        """In the order of their names."""
        if self._folder.is_dir():
            return sorted(
                p for p in self._folder.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and p.is_file()
            )
        found = glob.glob(str(self._folder), recursive=True)
        return sorted(path for path in map(Path, found) if path.is_file())

    @cached_property
    def root(self) -> Path:
        """The folder below which all photographs lie."""
        if self._folder.is_dir():
            return self._folder
        return Path(os.path.commonpath([path.parent for path in self.paths]))

    def name(self, path: Path) -> str:
        """A photograph's path below :attr:`root`, with ``/``."""
        return path.relative_to(self.root).as_posix()

    def read(self, path: Path) -> Image.Image:
        """A photograph in RGB. Raises ``ValueError`` where it cannot be read."""
        try:
            with Image.open(path) as photo:
                return photo.convert("RGB")
        except (OSError, UnidentifiedImageError) as error:
            raise ValueError(f"{self.key}: {path} is not a readable picture ({error})") from error
