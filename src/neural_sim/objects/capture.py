"""The data of a capture: photographs of one object with their cameras."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_log = logging.getLogger(__name__)

ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R R^T from the identity: files round to six digits, and pose optimisers drift."""
WIDEST = 3.0
"""Tangent of the angle off the axis up to which the distortion of a perspective lens is checked."""
FARTHEST = 1e3
"""Tangent of the largest angle off the axis that a pixel of a perspective lens may have."""
FOCAL_LENGTHS = (0.05, 1000.0)
"""Smallest and largest focal length, in units of the image's longer side: a view of 170 degrees, and a telescope."""
BISECTIONS = 64
REPETITIONS = 12


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera, with OpenCV's distortion.

    Lengths are in pixels; the principal point is measured from the image's upper left corner (the first pixel's centre
    is (0.5, 0.5), as in COLMAP and nerfstudio). A point (x, y) of the plane at distance 1, with radius r, is scaled by
    (1 + radial[0] r^2 + radial[1] r^4 + ...) / (1 + divisor[0] r^2 + ...), then shifted by the ``tangential`` p1 and
    p2. With ``fisheye``, r is the point's angle off the axis; the point is first moved to that radius, and there is no
    tangential term.

    Raises:
        ValueError: a size or focal length is not positive, a number is not finite, or a length is not in pixels.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.radial, *self.divisor, *self.tangential)
        if self.width < 1 or self.height < 1 or not np.isfinite(numbers).all():
            raise ValueError(f"want a size in pixels and finite numbers, got {self}")
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise ValueError(f"want positive focal lengths, got {self.fx} and {self.fy}")
        low, high = (factor * max(self.width, self.height) for factor in FOCAL_LENGTHS)
        if not (low <= self.fx <= high and low <= self.fy <= high):
            raise ValueError(
                f"want focal lengths in pixels, {low:g} to {high:g} for {self.width} x {self.height}, got {self.fx:g} "
                f"and {self.fy:g}"
            )
        if max(self.width, self.height) > 2 and 0.0 < self.cx <= 1.0 and 0.0 < self.cy <= 1.0:
            raise ValueError(f"want cx and cy in pixels, got the fractions {self.cx:g} and {self.cy:g}")

    def resized(self, width: int, height: int) -> Lens:
        """Return the lens for the same photograph at another size."""
        across, down = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=across * self.fx, fy=down * self.fy, cx=across * self.cx,
            cy=down * self.cy,
        )  # fmt: skip

    def project(self, local: Float[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Return the pixels (x, y) of points in the camera's OpenGL frame, and which of the points the lens can see.

        It sees no points behind the camera, and none so far off the axis that the distorted radius no longer increases.
        Pixels may lie outside the image.
        """
        depth = -local[..., 2]
        ahead = depth > 1e-9
        plane = torch.stack([local[..., 0], -local[..., 1]], -1) / depth.clamp_min(1e-9)[..., None]
        radius = plane.norm(dim=-1)
        along = torch.atan(radius) if self.fisheye else radius
        seen = ahead & (along < self._reach())
        ratio = torch.where(radius > 1e-12, along / radius.clamp_min(1e-12), torch.ones_like(radius))
        undistorted = plane
        plane = plane * (ratio * self._scale(along.square()))[..., None]
        if not self.fisheye and any(self.tangential):
            plane = plane + self._shift(undistorted)
        focal = plane.new_tensor([self.fx, self.fy])
        return plane * focal + plane.new_tensor([self.cx, self.cy]), seen

    def directions(self, pixel: Float[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n"]]:
        """Invert ``project``: return unit directions in the camera's OpenGL frame, and which pixels have one.

        The radius is found by bisection, which converges whatever the distortion. The small tangential term is removed
        by fixed-point iteration.
        """
        target = (pixel - pixel.new_tensor([self.cx, self.cy])) / pixel.new_tensor([self.fx, self.fy])
        reach = min(self._reach(), 0.5 * np.pi if self.fisheye else FARTHEST)
        plane = target
        for _ in range(REPETITIONS if any(self.tangential) and not self.fisheye else 1):
            goal = target - self._shift(plane)
            length = goal.norm(dim=-1)
            low, high = torch.zeros_like(length), torch.full_like(length, reach)
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                beyond = middle * self._scale(middle.square()) > length
                low, high = torch.where(beyond, low, middle), torch.where(beyond, middle, high)
            along = 0.5 * (low + high)
            radius = torch.tan(along.clamp_max(0.5 * np.pi - 1e-6)) if self.fisheye else along
            plane = goal * (radius / length.clamp_min(1e-12))[..., None]
        seen = reach * self._scale(along.new_tensor(reach**2)) > length
        local = torch.stack([plane[..., 0], -plane[..., 1], -torch.ones_like(plane[..., 0])], -1)
        return local / local.norm(dim=-1, keepdim=True), seen

    def _shift(self, plane: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Compute the tangential term."""
        (p1, p2), (x, y) = self.tangential, plane.unbind(-1)
        square = x * x + y * y
        moved = (
            2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
        return torch.stack(moved, -1)

    def _scale(self, square: Tensor) -> Tensor:
        return _polynomial(self.radial, square) / _polynomial(self.divisor, square)

    def _reach(self) -> float:
        """Compute the radius (or angle) up to which the distorted radius increases."""
        if not (any(self.radial) or any(self.divisor)):
            return float("inf") if not self.fisheye else 0.5 * np.pi
        at = torch.linspace(0.0, 0.5 * np.pi if self.fisheye else WIDEST, 4001, dtype=torch.float64)
        rising = (at * self._scale(at.square())).diff() > 0.0
        return float(at[-1] if rising.all() else at[int((~rising).int().argmax())])


def _polynomial(coefficients: tuple[float, ...], square: Tensor) -> Tensor:
    total = torch.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return 1.0 + total


@dataclass(frozen=True)
class Frame:
    """One photograph with its camera.

    ``camera_to_world`` has OpenGL axes (x right, y up, looking along -z), in the capture's frame and unit. ``mask`` is
    a separate image file; ``test`` marks frames of the capture's own test set.
    """

    image: Path
    camera_to_world: Float[np.ndarray, "4 4"]
    lens: Lens
    mask: Path | None = None
    test: bool = False


@dataclass(frozen=True)
class Capture:
    """The photographs of an object.

    ``source`` is the file or folder with their cameras; ``files`` are all files that the capture consists of; ``up`` is
    the world's up direction in the capture's frame, None if the source does not give it.

    Raises:
        ValueError: a photograph is listed twice, or all cameras are in the same place.
    """

    name: str
    frames: tuple[Frame, ...]
    source: Path
    files: tuple[Path, ...]
    up: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        first: dict[str, int] = {}
        for number, frame in enumerate(self.frames):
            before = first.setdefault(os.path.abspath(frame.image), number)
            if before != number:
                raise ValueError(
                    f"{self.source}: two of its poses are of {frame.image}; want one for each photograph"
                )
        places = np.array([frame.camera_to_world[:3, 3] for frame in self.frames])
        if len(places) > 1 and (places == places[0]).all():
            raise ValueError(
                f"{self.source}: its {len(places)} cameras are all at {places[0].tolist()}, want them around the object"
            )


def say_missing(source: Path, missing: Sequence[str], listed: int) -> None:
    """Warn about listed photographs that are missing and left out.

    Raises:
        ValueError: all ``listed`` photographs are missing.
    """
    if missing and len(missing) == listed:
        raise ValueError(
            f"{source}: all of its {listed} photographs are missing, such as {missing[0]}; put them at the "
            "paths that it lists"
        )
    if missing:
        _log.warning(
            "%s: %d of %d photographs are missing and left out, such as %s",
            source, len(missing), listed, missing[0],
        )  # fmt: skip


def checked_pose(matrix: object, where: str) -> Float[np.ndarray, "4 4"]:
    """Check a camera-to-world matrix of 3 or 4 rows, and return it with 4.

    Raises:
        ValueError: the matrix has another shape or entries that are not finite, its first three rows and columns are
            not a rotation, or its fourth row is not 0, 0, 0, 1.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: want a matrix of 4 x 4 numbers, got {matrix!r}") from error
    if pose.shape not in ((3, 4), (4, 4)) or not np.isfinite(pose).all():
        raise ValueError(
            f"{where}: want a matrix of 4 x 4 finite numbers, got shape {pose.shape}: {matrix!r}"
        )
    rotation = pose[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise ValueError(
            f"{where}: its first three rows and columns are not a rotation (R R^T is {error:.2g} off the identity, "
            f"determinant {np.linalg.det(rotation):.3g})"
        )
    if len(pose) == 4 and not np.allclose(pose[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=ROTATION_TOLERANCE):
        raise ValueError(
            f"{where}: want 0, 0, 0, 1 as its last row, got {pose[3].tolist()}; is it transposed?"
        )
    whole = np.eye(4)
    whole[:3] = pose[:3]
    return whole
