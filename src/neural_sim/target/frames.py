"""Photographs with known object poses, the interface of a data set's reader, and helpers that readers share."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float

from neural_sim.cameras import opencv_camera
from neural_sim.objects.capture import ROTATION_TOLERANCE
from neural_sim.pictures import by, read_header
from neural_sim.types import PinholeCamera


class FrameName(NamedTuple):
    """A photograph of a data set: its scene, which the split keeps together, and its number in it."""

    scene: str
    number: int

    def __str__(self) -> str:
        return f"{self.scene}/{self.number:06d}"


@dataclass(frozen=True)
class Listed:
    """Photographs for validation and for scoring; with ``test`` None, scenes of ``val`` are set aside for scoring."""

    val: Sequence[FrameName]
    test: Sequence[FrameName] | None


@dataclass(frozen=True, eq=False)
class PosedObject:
    """One object of a photograph.

    Args:
        name: its class in the data set.
        object_to_camera: rigid transform in metres from the frame of the data set's own model of the object to the
            camera's OpenCV axes (x right, y down, view along +z).
        box: (x0, y0, x1, y1) around the visible part, along pixel edges, where the image spans [0, width] x
            [0, height]; None: nothing is visible.
        visibility: the fraction of the object that is visible, in [0, 1], see the reader.
        mask: its visible pixels, if the data set has them.

    Raises:
        ValueError: the pose is not rigid, the box is not ordered, or the visibility is outside [0, 1].
    """

    name: str
    object_to_camera: Float[np.ndarray, "4 4"]
    box: tuple[float, float, float, float] | None
    visibility: float
    mask: Bool[np.ndarray, "height width"] | None = None

    def __post_init__(self) -> None:
        pose = self.object_to_camera
        if pose.shape != (4, 4) or not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
            raise ValueError(f"{self.name}: want a rigid 4 x 4 object_to_camera, got {pose.tolist()}")
        rigid(pose[:3, :3], pose[:3, 3], self.name)
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise ValueError(f"{self.name}: want a box x0 < x1, y0 < y1, got {self.box}")
        if not 0.0 <= self.visibility <= 1.0:
            raise ValueError(f"{self.name}: visibility must lie in [0, 1], got {self.visibility}")


@dataclass(frozen=True, eq=False)
class Frame:
    """One photograph with its camera, its objects and, if requested and present, its depth.

    ``depth`` is in metres along the view axis, 0 where unknown.

    Raises:
        ValueError: there is no such image, or the image, a mask or the depth has another size than the camera.
    """

    scene: str
    number: int
    image: Path
    camera: PinholeCamera
    objects: tuple[PosedObject, ...]
    depth: Float[np.ndarray, "height width"] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.width, self.camera.height)
        header = read_header(self.image)
        if header.stored != size or header.shown != size:
            raise ValueError(
                f"{self.image}: is {by(header.stored)} pixels, its camera {by(size)}{header.turning}"
            )
        grids = {f"the mask of {item.name}": item.mask for item in self.objects} | {"the depth": self.depth}
        for what, grid in grids.items():
            if grid is not None and grid.shape[::-1] != size:
                raise ValueError(
                    f"{self.image}: {what} is {by(grid.shape[::-1])} pixels, its camera {by(size)}"
                )


class FrameReader(Protocol):
    """Reads a data set's files, one photograph at a time. The target decides which photographs to take."""

    def class_names(self, scenes: Collection[str]) -> list[str]:
        """List the data set's classes; if no file has them, those that the scenes show."""
        ...

    def frame(self, name: FrameName, depth: bool = False) -> Frame:
        """Read one photograph, with its depth if requested.

        Raises:
            ValueError: files are missing or contradict each other; the message has the file and the error.
        """
        ...

    def camera(self, name: FrameName) -> PinholeCamera:
        """Read the camera of one photograph."""
        ...

    def files(self, name: FrameName) -> list[Path]:
        """List the files from which its labelled image is made."""
        ...

    def centre(self, class_name: str) -> Float[np.ndarray, "3"] | None:
        """Return an object's centre in the frame of its poses, in metres; None: the origin."""
        ...


def rigid(rotation: Any, translation: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """Return the 4 x 4 pose of a rotation (9 numbers, row by row) and a translation (3).

    Raises:
        ValueError: there are too few or too many numbers, some are not finite, or the matrix is not a rotation to the
            precision to which files round; the message has ``where``.
    """
    pose = np.eye(4)
    pose[:3, :3] = numbers(rotation, 9, f"{where}: rotation").reshape(3, 3)
    pose[:3, 3] = numbers(translation, 3, f"{where}: translation")
    turn = pose[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(turn) < 0.0:
        kind = (
            "a reflection"
            if off <= ROTATION_TOLERANCE
            else f"no rotation: R R^T differs from the identity by {off:.2g}"
        )
        raise ValueError(f"{where}: {turn.tolist()} is {kind}")
    return pose


def numbers(values: Any, count: int, where: str) -> Float[np.ndarray, "count"]:
    """Return ``count`` finite numbers.

    Raises:
        ValueError: the values are not ``count`` finite numbers; the message has ``where``.
    """
    try:
        made = np.asarray(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: want {count} numbers, got {values!r}") from error
    if made.size != count or not np.isfinite(made).all():
        raise ValueError(f"{where}: want {count} finite numbers, got {made.tolist()}")
    return made


def camera_of_matrix(matrix: Any, width: int, height: int, where: str) -> PinholeCamera:
    """Return the camera of an OpenCV camera matrix (9 numbers, row by row).

    Raises:
        ValueError: the matrix has another form or a skew, or its principal point is outside the image, as if it
            belonged to images of another size.
    """
    k = numbers(matrix, 9, where).reshape(3, 3)
    if k[0, 1] != 0.0 or k[1, 0] != 0.0 or not np.array_equal(k[2], (0.0, 0.0, 1.0)):
        raise ValueError(f"{where}: want [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}")
    if not (-0.5 <= k[0, 2] <= width - 0.5 and -0.5 <= k[1, 2] <= height - 0.5):
        raise ValueError(
            f"{where}: the principal point ({k[0, 2]:g}, {k[1, 2]:g}) lies outside the image of {width} x {height}"
        )
    try:
        return opencv_camera(width, height, *(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def box_of_mask(mask: Bool[np.ndarray, "height width"]) -> tuple[float, float, float, float] | None:
    """Return (x0, y0, x1, y1) along the edges of the pixels; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)
