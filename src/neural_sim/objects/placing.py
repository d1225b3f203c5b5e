"""An object's place in its capture's frame: the up direction, and centre and radius from the visual hull."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neural_sim.objects.capture import Capture, Frame, Lens
from neural_sim.objects.pictures import Corners, Pictures

_log = logging.getLogger(__name__)

AXES = {
    sign + axis: tuple((1.0 if sign == "+" else -1.0) if a == axis else 0.0 for a in "xyz")
    for sign, axis in itertools.product("+-", "xyz")
}
SMALL = 256
"""Silhouettes that carve the hull are reduced to a longer side of at least this many pixels."""
NEARLY_ALL = 0.95
"""Fraction of a photograph that a mask may cover before it is doubted."""
CELLS = 48
"""Number of cells along each side of the cube that is carved."""
OUTSIDE = 0.05
"""A hull cell may lie outside the silhouettes of this fraction of the views that see it, because poses and masks of
photographs are not exact."""
SEEN_BY = 0.5
"""Fraction of all views that must see a hull cell; those seen by few lie at the edges of photographs."""


@dataclass(frozen=True)
class Placement:
    """An object's place in its capture.

    ``to_object`` maps the capture's frame to the object's: +z up, inside the unit sphere around the origin. ``radius``
    is that sphere's radius in the capture's unit.
    """

    to_object: Float[np.ndarray, "4 4"]
    radius: float

    def pose(self, camera_to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Transform a camera's pose to the object's frame; rotations stay rotations."""
        moved = self.to_object @ camera_to_world
        moved[:3, :3] *= self.radius
        return moved


def place(pictures: Pictures, up: tuple[float, float, float] | None, box: Corners | None = None) -> Placement:
    """Place an object by the visual hull (Laurentini 1994) of its silhouettes, which gives centre and radius.

    ``up`` is in the capture's frame; None: its file's, or else the mean of the cameras' up vectors, which is logged.
    ``box`` bounds the hull; its sides are along the axes of the capture's frame.

    Raises:
        ValueError: the masks show no object, the visual hull is empty, or ``up`` has no direction.
    """
    capture = pictures.capture
    chosen = up if up is not None else capture.up
    if chosen is None:
        chosen = mean_up(capture)
        _log.info(
            "%s: up is assumed to be (%.3f, %.3f, %.3f), the mean of the cameras' up vectors; objects.up sets another",
            capture.name, *(np.array(chosen) / max(float(np.linalg.norm(chosen)), 1e-12)),
        )  # fmt: skip
    turn = upright(np.array(chosen, dtype=np.float64), capture.name)
    silhouettes = [silhouette(pictures, frame) for frame in capture.frames]
    _doubt(capture, silhouettes)
    centre, radius = sphere_of(capture, silhouettes, box)
    _log.info(
        "%s: centre (%.4g, %.4g, %.4g) and radius %.4g in the capture's unit, from %d silhouettes",
        capture.name, *centre, radius, len(capture.frames),
    )  # fmt: skip
    to_object = np.eye(4)
    to_object[:3, :3] = turn / radius
    to_object[:3, 3] = -to_object[:3, :3] @ centre
    return Placement(to_object, radius)


def mean_up(capture: Capture) -> tuple[float, float, float]:
    """Compute the mean of the cameras' up vectors, in the capture's frame."""
    x, y, z = np.stack([frame.camera_to_world[:3, 1] for frame in capture.frames]).mean(0).tolist()
    return x, y, z


def nearest_to_axes(camera_to_world: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "3"]:
    """Find the point nearest to the cameras' optical axes (least squares)."""
    axes, centres = -camera_to_world[:, :3, 2], camera_to_world[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.lstsq(across.sum(0), (across @ centres[:, :, None]).sum(0)[:, 0], rcond=None)[0]


def upright(up: Float[np.ndarray, "3"], name: str) -> Float[np.ndarray, "3 3"]:
    """Compute the smallest rotation from ``up`` to +z; raise ``ValueError`` for a vector without a direction."""
    length = float(np.linalg.norm(up))
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(f"{name}: up has no direction, got {up.tolist()}; set objects.up")
    x, y, z = up / length
    if z < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def silhouette(pictures: Pictures, frame: Frame) -> Bool[Tensor, "h w"]:
    """Read the object's mask at reduced size, where a pixel counts if any of the photograph's pixels in it does."""
    alpha = pictures.rgba(frame)[..., 3]
    step = max(1, max(alpha.shape) // SMALL)
    return functional.max_pool2d(alpha[None, None], step, ceil_mode=True)[0, 0] > 0.5


def _doubt(capture: Capture, silhouettes: Sequence[Bool[Tensor, "_ _"]]) -> None:
    """Warn about masks that touch the edges of their photographs or cover nearly all of them."""
    kinds = {
        "touch the edges of their photographs, beyond which the object is unknown": lambda mask: bool(
            torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any()
        ),
        "cover nearly all of their photographs": lambda mask: float(mask.float().mean()) > NEARLY_ALL,
    }
    for what, holds in kinds.items():
        found = [frame.image for frame, mask in zip(capture.frames, silhouettes, strict=True) if holds(mask)]
        if found:
            _log.warning(
                "%s: the masks of %d of %d photographs %s, such as that of %s",
                capture.name, len(found), len(silhouettes), what, found[0],
            )  # fmt: skip


def sphere_of(
    capture: Capture, silhouettes: Sequence[Bool[Tensor, "_ _"]], box: Corners | None = None
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return centre and radius of the silhouettes' visual hull, or of its part in a box, in the capture's frame."""
    empty = [frame.image for frame, mask in zip(capture.frames, silhouettes, strict=True) if not mask.any()]
    if len(empty) == len(silhouettes):
        raise ValueError(
            f"{capture.source}: no object in the masks of {capture.name}, such as that of {empty[0]}"
        )
    if empty:
        _log.warning(
            "%s: no object in the masks of %d photographs, such as %s", capture.name, len(empty), empty[0]
        )
    shown = [(frame, mask) for frame, mask in zip(capture.frames, silhouettes, strict=True) if mask.any()]
    ends = torch.tensor([[-math.inf] * 3, [math.inf] * 3] if box is None else box, dtype=torch.float64)
    centre, half = _first_cube(shown) if box is None else _cube_of(box)
    # First by whole cells, so that no thin part is missed; then by their centres, in a cube that fits the first hull.
    for reach in (0.5 * np.sqrt(3.0), 0.0):
        cell = 2.0 * half / CELLS
        axis = torch.linspace(-half + 0.5 * cell, half - 0.5 * cell, CELLS, dtype=torch.float64)
        cells = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(
            -1, 3
        ) + torch.from_numpy(centre)
        cells = cells[((cells + reach * cell > ends[0]) & (cells - reach * cell < ends[1])).all(1)]
        hull = cells[_carved(shown, cells, reach * cell)] if len(cells) else cells
        if not len(hull):
            raise ValueError(
                f"{capture.source}: the visual hull of {capture.name} is empty; check masks, poses and axes"
            )
        low, high = hull.amin(0) - 0.5 * cell, hull.amax(0) + 0.5 * cell
        centre = (0.5 * (low + high)).numpy()
        radius = float((hull - torch.from_numpy(centre)).norm(dim=-1).max()) + 0.5 * cell
        half = 1.1 * radius
    return centre, radius


def _cube_of(box: Corners) -> tuple[np.ndarray, float]:
    """Return the centre of a box, and half the side of a cube around it."""
    low, high = np.array(box)
    return 0.5 * (low + high), 0.5 * float((high - low).max())


def _first_cube(shown: Sequence[tuple[Frame, Tensor]]) -> tuple[np.ndarray, float]:
    """Return centre and half side of a cube around the point nearest to the rays through the silhouettes' centres."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    spans = []
    for frame, mask in shown:
        rows, columns = (np.flatnonzero(mask.any(axis).numpy()) for axis in (1, 0))
        scale = frame.lens.width / mask.shape[1]
        ends = [
            scale * np.array([columns[end] + edge, rows[end] + edge]) for end, edge in ((0, 0.0), (-1, 1.0))
        ]
        middle = 0.5 * (ends[0] + ends[1])
        lens = frame.lens
        local = np.array([(middle[0] - lens.cx) / lens.fx, -(middle[1] - lens.cy) / lens.fy, -1.0])
        direction = frame.camera_to_world[:3, :3] @ (local / np.linalg.norm(local))
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ frame.camera_to_world[:3, 3]
        spans.append(0.5 * float(np.linalg.norm((ends[1] - ends[0]) / np.array([lens.fx, lens.fy]))))
    centre = np.linalg.lstsq(normal, right, rcond=None)[0]
    depths = [float(np.linalg.norm(frame.camera_to_world[:3, 3] - centre)) for frame, _ in shown]
    return centre, 1.5 * max(depth * span for depth, span in zip(depths, spans, strict=True))


def _carved(
    shown: Sequence[tuple[Frame, Tensor]], cells: Float[Tensor, "n 3"], reach: float
) -> Bool[Tensor, "n"]:
    """Find the hull's cells: nearly all photographs that see a cell show the object within ``reach`` of it."""
    seen, missed = torch.zeros(len(cells)), torch.zeros(len(cells))
    for frame, mask in shown:
        lens, pose = frame.lens, torch.from_numpy(frame.camera_to_world)
        local = (cells - pose[:3, 3]) @ pose[:3, :3]
        pixel, ahead = lens.project(local)
        scale = mask.shape[1] / lens.width
        nearest = float((-local[:, 2]).clamp_min(1e-6).median())
        by = int(np.ceil(scale * max(lens.fx, lens.fy) * reach / nearest)) + 1
        grown = functional.max_pool2d(mask[None, None].float(), 2 * by + 1, 1, by)[0, 0] > 0.0
        inside, value = _at(grown, pixel, lens)
        visible = inside & ahead
        seen += visible
        missed += visible & ~value
    return (seen >= SEEN_BY * len(shown)) & (missed <= OUTSIDE * seen)


def _at(mask: Tensor, pixel: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
    """Return whether pixels lie in the image, and the reduced mask's values there."""
    size = pixel.new_tensor([lens.width, lens.height])
    inside = ((pixel >= 0.0) & (pixel < size)).all(-1)
    place = (pixel / size * pixel.new_tensor([mask.shape[1], mask.shape[0]])).nan_to_num(0.0).long()
    return inside, mask[place[:, 1].clamp(0, mask.shape[0] - 1), place[:, 0].clamp(0, mask.shape[1] - 1)]
