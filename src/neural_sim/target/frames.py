"""A photograph whose objects' poses are known, the reader that a data set has, and what readers share."""

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
    """A photograph of a data set: its scene, which the split keeps together, and its number there."""

    scene: str
    number: int

    def __str__(self) -> str:
        return f"{self.scene}/{self.number:06d}"


@dataclass(frozen=True)
class Listed:
    """Photographs for validation and photographs that are scored; ``test`` None: scenes of ``val`` are set aside."""

    val: Sequence[FrameName]
    test: Sequence[FrameName] | None


@dataclass(frozen=True, eq=False)
class PosedObject:
    """One object of a photograph.

    Args:
        name: its class in the data set.
        object_to_camera: rigid, OpenCV axes (x right, y down, view along +z), metres; from the frame that the data
            set's own model of the object has.
        box: (x0, y0, x1, y1) round what is visible of it, along pixel edges, the image spanning [0, width] x
            [0, height]; None: nothing is.
        visibility: the fraction of the object that is visible, in [0, 1], see the reader.
        mask: its visible pixels, where the data set has them.

    Raises:
        ValueError: a pose that is not rigid, a box that is not ordered, a visibility outside of [0, 1].
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
    """One photograph with its camera, its objects and, where asked for and present, its depth.

    ``depth`` is in metres along the view axis, 0 where unknown.

    Raises:
        ValueError: no such image, or an image, a mask or a depth of another size than the camera's.
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
    """The files of a data set: what one photograph is said to show. Which ones there are to take, a target says."""

    def class_names(self, scenes: Collection[str]) -> list[str]:
        """List the data set's classes; where no file has them, those that the scenes show."""
        ...

    def frame(self, name: FrameName, depth: bool = False) -> Frame:
        """Read one photograph, with its depth where that is asked for.

        Raises:
            ValueError: files that are missing or contradict each other, with the file and what is wrong.
        """
        ...

    def camera(self, name: FrameName) -> PinholeCamera:
        """Read the camera of one photograph."""
        ...

    def files(self, name: FrameName) -> list[Path]:
        """List the files that its labelled image is made from."""
        ...

    def centre(self, class_name: str) -> Float[np.ndarray, "3"] | None:
        """Return an object's centre in the frame of its poses, in metres; None: the origin."""
        ...


def rigid(rotation: Any, translation: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """Return the 4 x 4 pose of a rotation (9 numbers, row by row) and a translation (3).

    Raises:
        ValueError: another number of numbers, some that are not finite, or a matrix that is no rotation to the digits
            that files round to; ``where`` says whose they are.
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
            else f"no rotation, R R^T is off the identity by {off:.2g}"
        )
        raise ValueError(f"{where}: {turn.tolist()} is {kind}")
    return pose


def numbers(values: Any, count: int, where: str) -> Float[np.ndarray, "count"]:
    """Return ``count`` finite numbers.

    Raises:
        ValueError: anything else; ``where`` says whose they are.
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
        ValueError: a matrix of another form or with skew, or a principal point outside of the image, as one has that
            belongs to images of another size.
    """
    k = numbers(matrix, 9, where).reshape(3, 3)
    if k[0, 1] != 0.0 or k[1, 0] != 0.0 or not np.array_equal(k[2], (0.0, 0.0, 1.0)):
        raise ValueError(f"{where}: want [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}")
    if not (-0.5 <= k[0, 2] <= width - 0.5 and -0.5 <= k[1, 2] <= height - 0.5):
        raise ValueError(
            f"{where}: the principal point ({k[0, 2]:g}, {k[1, 2]:g}) lies outside of the image of {width} x {height}"
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
