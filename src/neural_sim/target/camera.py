"""The camera of synthesised and rendered target images: a given one, or that of the target's photographs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

from annotated_types import Gt, Lt
from typing_extensions import override

from neural_sim.cameras import opencv_camera, resized
from neural_sim.ranges import Positive, PositiveInt, With, validated
from neural_sim.target.base import Target
from neural_sim.types import PinholeCamera


class CameraSource(Protocol):
    """The configuration of a camera."""

    def camera(self, image_size: int, field_of_view_deg: float, target: Target) -> PinholeCamera:
        """Return the camera.

        Args:
            image_size: side of a square image in pixels, for a source that gives no size.
            field_of_view_deg: vertical field of view, for a source that gives neither this nor a focal length.
            target: the run's target.
        """
        ...


@validated
@dataclass(frozen=True)
class GivenCamera(CameraSource):
    """A camera given by its field of view or by its OpenCV camera matrix.

    Args:
        width, height: size in pixels; both null: a square image of the training's size.
        field_of_view_deg: vertical field of view, for square pixels and a principal point in the image's centre; null
            and no focal length given: that of the objects' views.
        fx, fy: focal lengths in pixels; ``fy`` null: square pixels.
        cx, cy: principal point in pixels from the centre of the upper left pixel, as in OpenCV; null: the
            image's centre, (width - 1) / 2 and (height - 1) / 2.

    Raises:
        ValueError: both a focal length and a field of view are given, or ``fy``, ``cx`` or ``cy`` without ``fx``.
    """

    width: Annotated[PositiveInt | None, With("height")] = None
    height: PositiveInt | None = None
    field_of_view_deg: Annotated[float, Gt(0), Lt(180)] | None = None
    fx: Positive | None = None
    fy: Positive | None = None
    cx: float | None = None
    cy: float | None = None

    def __post_init__(self) -> None:
        if self.fx is None and any(value is not None for value in (self.fy, self.cx, self.cy)):
            raise ValueError(f"camera: fy, cx and cy need fx, got fy={self.fy}, cx={self.cx}, cy={self.cy}")
        if self.fx is not None and self.field_of_view_deg is not None:
            raise ValueError(
                f"camera: want fx or field_of_view_deg, got {self.fx} and {self.field_of_view_deg}"
            )

    @override
    def camera(self, image_size: int, field_of_view_deg: float, target: Target) -> PinholeCamera:
        width = image_size if self.width is None else self.width
        height = image_size if self.height is None else self.height
        if self.fx is not None:
            fy = self.fx if self.fy is None else self.fy
            return opencv_camera(width, height, self.fx, fy, self.cx, self.cy)
        angle = field_of_view_deg if self.field_of_view_deg is None else self.field_of_view_deg
        return PinholeCamera(width, height, math.radians(angle))


@validated
@dataclass(frozen=True)
class TargetCamera(CameraSource):
    """The camera that took the target's photographs, with images scaled to the detector's size.

    Args:
        width: width of the detector's images in pixels, with the height in proportion; null: the photographs' own.

    Raises:
        ValueError: the width is below 1; from ``camera``: the target has no known camera.
    """

    width: PositiveInt | None = None

    @override
    def camera(self, image_size: int, field_of_view_deg: float, target: Target) -> PinholeCamera:
        own = target.camera()
        if self.width is None:
            return own
        return resized(own, self.width, max(1, round(own.height * self.width / own.width)))


def camera_of_entry(entry: Any, where: str) -> PinholeCamera:
    """Return the camera of a mapping with ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` (OpenCV, pixels).

    Raises:
        ValueError: a key is missing or unknown (photographs with distortion must be undistorted first), or its value
            is not a number, a whole one for a side; the message has ``where``.
    """
    sides, others = ("width", "height"), ("fx", "fy", "cx", "cy")
    keys, got = {*sides, *others}, entry if isinstance(entry, dict) else {}
    wrong = keys ^ set(got)
    wrong |= {key for key in keys & set(got) if type(got[key]) not in (int, float)}
    wrong |= {key for key in sides if type(got.get(key)) is float and not got[key].is_integer()}
    if wrong:
        raise ValueError(
            f"{where}: want whole numbers {', '.join(sides)} and numbers {', '.join(others)} (OpenCV, pixels) and "
            f"nothing else; wrong, missing or unknown: {', '.join(sorted(wrong))}"
        )
    try:
        return opencv_camera(*(int(got[key]) for key in sides), *(float(got[key]) for key in others))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
