"""Photographs with unknown cameras: their files, and what EXIF says about their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import ExifTags

from neural_sim.pictures import (
    OTHER_FORMATS,
    PHOTO_SUFFIXES,
    Header,
    Size,
    picture_files,
    read_exif,
    read_header,
    say_strange,
    without_leftovers,
)

FOLDER = "images"
FILM_DIAGONAL = 43.27
"""Diagonal in millimetres of the 36 x 24 mm film to which EXIF's equivalent focal length refers."""
UP = {1: (0, 1), 2: (0, 1), 3: (0, -1), 4: (0, -1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""The upright picture's up direction in the stored picture (x to the right, y up), by EXIF orientation."""


@dataclass(frozen=True)
class Shot:
    """A photograph: its header, and the camera that took it.

    ``focal`` is the focal length in pixels according to EXIF, or None. Photographs with the same ``camera`` share their
    intrinsics.
    """

    image: Path
    header: Header
    camera: tuple[object, ...]
    focal: float | None

    @property
    def size(self) -> Size:
        """Width and height of the stored pixels."""
        return self.header.stored

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """The up direction according to EXIF, in the camera's OpenGL frame."""
        return np.array([*UP[self.header.orientation], 0.0])


@dataclass(frozen=True)
class Album:
    """The photographs of one object, in the order of their file names."""

    name: str
    folder: Path
    shots: tuple[Shot, ...]

    def called(self, shot: Shot) -> str:
        """Return a photograph's path relative to ``folder``, its name in messages and results."""
        return shot.image.relative_to(self.folder).as_posix()


def pictures_of(folder: Path) -> list[Path]:
    """Return a capture's photographs: those in its subfolder ``images`` or, if it has none, in the folder itself."""
    if (folder / FOLDER).is_dir():
        return picture_files(folder / FOLDER)
    own = sorted(
        path for path in folder.iterdir() if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file()
    )
    return without_leftovers(own, folder)


def read_album(folder: Path, name: str) -> Album:
    """Read the headers of the photographs in a capture's folder.

    Raises:
        ValueError: a photograph cannot be read, or the folder has none.
    """
    strange = say_strange(folder, _files(folder), OTHER_FORMATS)
    pictures = pictures_of(folder)
    if not pictures:
        raise ValueError(f"{folder}: {_without_pictures(strange)}")
    return Album(name, folder, tuple(_shot(path) for path in pictures))


def _home(folder: Path) -> Path:
    return folder / FOLDER if (folder / FOLDER).is_dir() else folder


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in _home(folder).iterdir() if path.is_file())


def _without_pictures(strange: Sequence[str]) -> str:
    return f"holds no photographs ({', '.join(PHOTO_SUFFIXES)})" + (
        "; convert its other pictures to JPEG" if strange else ""
    )


def _shot(path: Path) -> Shot:
    header = read_header(path)
    known = read_exif(path)
    tags = ExifTags.Base
    camera = (
        header.stored,
        *(known.get(tag) for tag in (tags.Make, tags.Model, tags.LensModel, tags.FocalLength)),
    )
    equivalent = _number(known.get(tags.FocalLengthIn35mmFilm))
    focal = equivalent * float(np.hypot(*header.stored)) / FILM_DIAGONAL if equivalent else None
    return Shot(path, header, (*camera, equivalent), focal)


def _number(value: object) -> float | None:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0.0 else None
