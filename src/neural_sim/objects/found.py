"""Judge the cameras that were found from photographs, and say why some or all are missing."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from neural_sim.objects.album import Album, Shot
from neural_sim.objects.capture import Capture
from neural_sim.objects.placing import mean_up, nearest_to_axes, upright

_log = logging.getLogger(__name__)

LEAST = 8
"""Fewest photographs from which an object can be made."""
ONE_PLACE = 0.08
"""Largest extent of the cameras that counts as one place, relative to their distance from what they show."""
TURNED_ALONE = ("PANORAMIC", "PLANAR_OR_PANORAMIC")
"""COLMAP's names for pairs of photographs that a rotation of the camera explains without translation."""
MOST_TURNS = 0.5
"""Fraction of such pairs above which photographs are assumed to be taken from one place."""
POOR_ERROR = 1.5
"""Mean error, in pixels of the reduced photographs, above which cameras are doubted; good captures have 0.3 to 0.8."""
FEW = 0.7
"""If cameras of fewer than this fraction of the photographs are found, a warning says what to do."""
NAMED = 12
"""Largest number of photographs that a message lists by name."""
ONE_SIDED = 0.2
"""Length of the cameras' mean horizontal direction above which they are on one side; it is 0 if they are all around."""
LEVEL = 0.1
"""Smallest spread of the cameras' horizontal axes in a second direction (root mean square) from which up is found."""
SIDEWAYS = 0.5
"""A photograph lies on its side if another of its axes is nearer to the others' up direction by this much (cosine)."""

_OVERLAP = "let each photograph show two thirds of what the one before shows, and add texture, such as a printed sheet"


@dataclass(frozen=True)
class FoundCapture:
    """A capture whose cameras were found.

    Args:
        capture: the photographs that have a camera.
        error: mean reprojection error, in pixels of the reduced photographs.
        points: number of points that were reconstructed along with the cameras.
        missing: names of the photographs without a camera.
        apart: number of missing photographs that fit together, but not with those of the capture.
        turning: whether the room stands still in the photographs while the object turns.
    """

    capture: Capture
    error: float
    points: int
    missing: tuple[str, ...] = ()
    apart: int = 0
    turning: bool = False

    def tell(self) -> None:
        """Log what was found and what was left out."""
        name, known = self.capture.name, len(self.capture.frames)
        total = known + len(self.missing)
        _log.info(
            "%s: found the cameras of %d of %d photographs, with %d points and a mean error of %.2f pixels",
            name, known, total, self.points, self.error,
        )  # fmt: skip
        if self.missing:
            advice = f"; {_OVERLAP}" if known < FEW * total else ""
            apart = f"; {self.apart} of them fit together, but not with the others" if self.apart else ""
            _log.warning(
                "%s: no camera found for %d photographs, which are left out: %s%s%s",
                name, len(self.missing), listed(self.missing), apart, advice,
            )  # fmt: skip
        if self.error > POOR_ERROR:
            _log.warning(
                "%s: the cameras fit the photographs only to within %.2f pixels: did the object or the room move, or "
                "was the picture stabilised or zoomed?", name, self.error,
            )  # fmt: skip
        if self.turning:
            _log.warning(
                "%s: the room stands still in the photographs while the object turns: cameras are relative to the "
                "object, and the room says nothing about them; set objects.masks=files or command, because "
                "objects.masks=scene cannot find the object", name,
            )  # fmt: skip


def listed(names: Sequence[str]) -> str:
    """List names; if there are many, only the first ones."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def judged(
    album: Album,
    models: Sequence[tuple[Any, Capture]],
    verified: Mapping[tuple[int, int], tuple[str, int]],
    turning: bool,
) -> FoundCapture:
    """Return the largest of COLMAP's models, if an object can be made from it.

    Args:
        album: the photographs.
        models: COLMAP's models, the largest first, each with its capture.
        verified: pairs of photographs that a motion explains, with the kind of motion and the number of matches.
        turning: see ``FoundCapture``.

    Raises:
        ValueError: too few photographs fit together, or all come from one place; the message says what to do.
    """
    total = len(album.shots)
    if not models or len(models[0][1].frames) < LEAST:
        count = len(models[0][1].frames) if models else 0
        raise ValueError(f"{album.folder}: {_why_not(verified, count, total)}")
    model, capture = models[0]
    extent = _extent(model, capture)
    if extent < ONE_PLACE:
        raise ValueError(
            f"{album.folder}: the photographs were taken from nearly one place (within {100.0 * extent:.1f} % of the "
            "distance to what they show); walk around the object, with a step between photographs"
        )
    capture = in_own_frame(capture)
    known = {frame.image for frame in capture.frames}
    missing = tuple(album.called(shot) for shot in album.shots if shot.image not in known)
    apart = len({frame.image for _, other in models[1:2] for frame in other.frames} - known)
    error = float(model.compute_mean_reprojection_error())
    return FoundCapture(capture, error, model.num_points3D(), missing, apart, turning)


def _why_not(verified: Mapping[tuple[int, int], tuple[str, int]], count: int, total: int) -> str:
    """Say why no cameras were found, and what to do."""
    if not verified:
        return f"no two of the {total} photographs have enough in common to find cameras; {_OVERLAP}"
    kinds = Counter(kind for kind, _ in verified.values())
    if sum(kinds[kind] for kind in TURNED_ALONE) > MOST_TURNS * len(verified):
        return "the photographs were taken from one place; walk around the object, with a step between photographs"
    return f"only {count} of {total} photographs fit together, want at least {LEAST}; {_OVERLAP}"


def _extent(model: Any, capture: Capture) -> float:
    """Return the largest distance of a camera from the cameras' centre, relative to the median distance of points."""
    centres = np.stack([frame.camera_to_world[:3, 3] for frame in capture.frames])
    points = np.array([point.xyz for point in model.points3D.values()])
    away = np.median(np.linalg.norm(points - centres.mean(0), axis=1))
    return float(np.linalg.norm(centres - centres.mean(0), axis=1).max() / max(away, 1e-12))


def common_up(poses: Float[np.ndarray, "n 4 4"], shots: Sequence[Shot]) -> tuple[float, float, float]:
    """Return the direction that is up in most photographs, in the capture's frame.

    It is perpendicular (in least squares) to the pictures' horizontal axes, because people hold cameras level and tilt
    them down; if these axes nearly coincide, it is the mean of the pictures' own up directions. If a photograph lies on
    its side and no EXIF says so, the axis that agrees best with the others counts as its up direction.
    """
    own = np.stack([pose[:3, :3] @ shot.up for pose, shot in zip(poses, shots, strict=True)])
    axes = np.concatenate([poses[:, :3, :2], -poses[:, :3, :2]], -1)  # right, up, left, down of each camera
    chosen = own
    for _ in range(8):
        mean = chosen.mean(0)
        mean /= max(float(np.linalg.norm(mean)), 1e-12)
        fits = np.einsum("nik,i->nk", axes, mean)
        best = np.take_along_axis(axes, fits.argmax(1)[:, None, None], 2)[:, :, 0]
        turned = fits.max(1) > own @ mean + SIDEWAYS
        chosen = np.where(turned[:, None], best, own)
    mean = chosen.mean(0)
    spread, axes = np.linalg.svd(np.cross(chosen, poses[:, :3, 2]))[1:]
    if spread[1] > LEVEL * np.sqrt(len(poses)):
        mean = axes[2] * np.sign(axes[2] @ mean)
    x, y, z = mean.tolist()
    return x, y, z


def in_own_frame(capture: Capture) -> Capture:
    """Return a capture in a meaningful frame, because COLMAP's is arbitrary.

    +z is up, the origin is the point that the cameras look at, and their median distance from it is 1. The cameras'
    mean direction, or that of the first camera if they are all around, is towards +x.
    """
    poses = np.stack([frame.camera_to_world for frame in capture.frames])
    up = np.array(capture.up if capture.up is not None else mean_up(capture))
    turn, centre = upright(up, capture.name), nearest_to_axes(poses)
    places = (poses[:, :3, 3] - centre) @ turn.T
    scale = 1.0 / max(float(np.median(np.linalg.norm(places, axis=1))), 1e-12)
    across = places[:, :2] / np.linalg.norm(places[:, :2], axis=1, keepdims=True).clip(1e-12)
    ahead = across.mean(0) if np.linalg.norm(across.mean(0)) > ONE_SIDED else across[0]
    angle = float(np.arctan2(ahead[1], ahead[0]))
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ turn
    frames = []
    for frame, pose in zip(capture.frames, poses, strict=True):
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn @ pose[:3, :3], scale * turn @ (pose[:3, 3] - centre)
        frames.append(replace(frame, camera_to_world=moved))
    return replace(capture, frames=tuple(frames), up=(0.0, 0.0, 1.0))
