"""Pose bins of photographs: the bin of p_psi that a camera's pose falls into, and photographs chosen by their bins.

A viewpoint is the inverse of the project's orbit: the side from which a camera sees an object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import LabelledImages, SceneDraw

TURN = 2.0 * math.pi
SAME = 1e-6
"""Difference in radians up to which two names of one viewpoint lie equally far outside the ranges."""
Range = tuple[float, float]


@dataclass(frozen=True)
class Viewpoint:
    """Cameras as ``neural_sim.cameras.orbit`` places them, float64.

    ``phi`` and ``rho`` are its angles in radians; ``distance`` is measured from the object's centre, in the unit of the
    poses. ``roll``, in [-pi, pi], turns the orbit's camera about its own backward axis, anticlockwise seen from behind:
    camera_to_world = orbit(phi, rho, distance) Rz(roll), for a camera that looks straight at the object's centre.
    """

    phi: Float[Tensor, "n"]
    rho: Float[Tensor, "n"]
    distance: Float[Tensor, "n"]
    roll: Float[Tensor, "n"]


def viewpoint_of(
    object_to_camera: Float[Tensor, "n 4 4"],
    centre: Float[Tensor, "#n 3"] | None = None,
    phi_range: Range = (0.0, TURN),
    rho_range: Range = (-math.pi, math.pi),
) -> Viewpoint:
    """Find the orbit's camera that sees an object from the same side as a real camera.

    An orbit's camera looks straight at the object; a real camera rarely does. Its direction from the object is kept,
    and it is turned to face the object by the smallest possible rotation; what remains is the roll. The object's
    position in the image does not affect the angles.

    (phi, rho, roll) and (-phi, rho + pi, roll + pi) are the same camera. The triple within the ranges is taken, or the
    one that misses them by less; if both miss by the same amount, for instance because both ranges are full circles,
    the one with the smaller absolute roll. Angles are within half a turn of the middle of their range. At the poles,
    where rho and roll have the same effect, rho is 0 or pi.

    Args:
        object_to_camera: rigid, OpenCV axes (x right, y down, view along +z); the object stands upright along its +z.
        centre: the object's centre in its own frame, in the unit of the poses; None: the origin.
        phi_range: range of the first angle, in radians.
        rho_range: range of the second angle, in radians.

    Raises:
        ValueError: a camera is at the object's centre, or faces exactly away from it.
    """
    pose = object_to_camera.double()
    turn, offset = pose[:, :3, :3], pose[:, :3, 3]
    if centre is not None:
        offset = offset + torch.einsum("nij,nj->ni", turn, centre.double().expand(len(pose), 3))
    distance = offset.norm(dim=-1)
    # The camera's OpenGL axes in the object's frame are rows of the rotation, with z reversed.
    right, backward = turn[:, 0], -turn[:, 2]
    toward = -torch.einsum("nij,ni->nj", turn, offset) / distance.clamp_min(1e-300)[:, None]
    if not bool((distance > 0.0).all() and ((backward * toward).sum(-1) > -1.0 + 1e-12).all()):
        raise ValueError(
            "want a camera away from the object's centre that does not face exactly away from it"
        )
    right = _turned(right, backward, toward)
    theta = torch.atan2(toward[:, :2].norm(dim=-1), toward[:, 2])
    azimuth = torch.atan2(toward[:, 1], toward[:, 0])
    orbits_right, orbits_up = _orbit_axes(theta, azimuth)
    roll = torch.atan2((right * orbits_up).sum(-1), (right * orbits_right).sum(-1))
    names = [_named(theta, azimuth, roll, phi_range, rho_range),
             _named(-theta, azimuth + math.pi, roll + math.pi, phi_range, rho_range)]  # fmt: skip
    outside = [_outside(name[0], phi_range) + _outside(name[1], rho_range) for name in names]
    alike = (outside[0] - outside[1]).abs() <= SAME
    second = torch.where(alike, names[1][2].abs() < names[0][2].abs(), outside[1] < outside[0])
    phi, rho, roll = (torch.where(second, b, a) for a, b in zip(*names, strict=True))
    return Viewpoint(phi, rho, distance, roll)


def bins_of_poses(
    distribution: SceneDistribution,
    object_to_camera: Float[Tensor, "n 4 4"],
    radius: float | None,
    centre: Float[Tensor, "#n 3"] | None = None,
) -> Int[Tensor, "n"]:
    """Return the bin of each pose by the first binned factor of p_psi, from 0, as in ``LabelledImages.bins``.

    Poses are in metres; ``radius`` is that of the object's sphere, None if unknown. The bin is -1 if the pose does not
    determine it: the factor is a focal length, or a distance in radii of an object of unknown size, or there is no
    binned factor. A distance outside the range falls into the bin at that end.
    """
    unknown = torch.full((len(object_to_camera),), -1)
    first = next(iter(distribution.binned), None)
    if first is None or first.coordinate not in ("phi", "rho", "distance"):
        return unknown
    ranges = {**distribution.ranges, **{f.coordinate: (f.low, f.high) for f in distribution.binned}}
    seen = viewpoint_of(object_to_camera, centre, ranges["phi"], ranges["rho"])
    distance = seen.distance
    if distribution.distance_unit == "radii":
        if radius is None and first.coordinate == "distance":
            return unknown
        distance = distance / (1.0 if radius is None else radius)
    none = torch.zeros(len(distance), 0, dtype=torch.long)
    return first.stratum_of(SceneDraw(seen.phi, seen.rho, distance, none))


def _turned(axis: Tensor, start: Tensor, end: Tensor) -> Float[Tensor, "n 3"]:
    """Rotate ``axis`` by the smallest rotation that takes the unit vector ``start`` to ``end`` (Rodrigues' formula)."""
    normal = torch.linalg.cross(start, end)
    once = torch.linalg.cross(normal, axis)
    return axis + once + torch.linalg.cross(normal, once) / (1.0 + (start * end).sum(-1, keepdim=True))


def _orbit_axes(phi: Tensor, rho: Tensor) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return right and up of the orbit's camera."""
    up = torch.stack([-phi.cos() * rho.cos(), -phi.cos() * rho.sin(), phi.sin()], -1)
    return torch.stack([-rho.sin(), rho.cos(), torch.zeros_like(rho)], -1), up


def _named(
    phi: Tensor, rho: Tensor, roll: Tensor, phi_range: Range, rho_range: Range
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the same angles within half a turn of the middle of their ranges, and the roll within half a turn of 0."""
    middles = 0.5 * sum(phi_range), 0.5 * sum(rho_range), 0.0
    phi, rho, roll = (
        middle + torch.remainder(angle - middle + math.pi, TURN) - math.pi
        for angle, middle in zip((phi, rho, roll), middles, strict=True)
    )
    return phi, rho, roll


def _outside(angle: Tensor, range_: Range) -> Tensor:
    """Return by how much an angle lies outside its range."""
    return ((angle - 0.5 * sum(range_)).abs() - 0.5 * (range_[1] - range_[0])).clamp_min(0.0)


def matching(
    images: LabelledImages,
    rows: Int[Tensor, "part"],
    targets: Mapping[str, Float[Tensor, "_"]],
    generator: torch.Generator,
    where: str,
) -> Int[Tensor, "chosen"]:
    """Choose those photographs of ``rows`` whose bins follow ``targets``.

    ``targets`` has each object's distribution over bins, in label order. For every object, as many photographs are
    chosen as its distribution allows, each at most once and at random within a bin. The number in a bin is that of the
    distribution, rounded up or down. Photographs without a box that has a bin are left out, and so are objects without
    photographs.

    Raises:
        ValueError: a photograph shows several objects or bins, or none shows a bin that the distribution needs; the
            message begins with ``where``.
    """
    cells = _rows_by_cell(images, rows, tuple(targets), where)
    chosen: list[int] = []
    for label, (name, p) in enumerate(targets.items()):
        own = [cells.get((label, b), []) for b in range(len(p))]
        if not any(own):
            continue
        counts = most(p.tolist(), [len(each) for each in own], generator)
        if counts is None:
            lacking = [b for b, each in enumerate(own, 1) if not each]
            raise ValueError(
                f"{where}: want {name} in the bins with p = {[round(v, 3) for v in p.tolist()]}, but no photograph "
                f"shows it in bins {lacking}"
            )
        for each, count in zip(own, counts, strict=True):
            order = torch.randperm(len(each), generator=generator)[:count].tolist()
            chosen += [each[i] for i in order]
    if not chosen:
        raise ValueError(f"{where}: no photograph has a box with a pose bin")
    return torch.tensor(sorted(chosen))


def _rows_by_cell(
    images: LabelledImages, rows: Int[Tensor, "part"], names: Sequence[str], where: str
) -> dict[tuple[int, int], list[int]]:
    """Return the rows that show an object in a bin, by its label and the bin."""
    cells: dict[tuple[int, int], list[int]] = {}
    for row in rows.tolist():
        labels, bins = images.labels[row].tolist(), _bins(images, row)
        seen = {(label, b) for label, b in zip(labels, bins, strict=True) if label >= 0}
        if len(seen) > 1:
            shown = ", ".join(f"{names[label]} in bin {b + 1 or 'unknown'}" for label, b in sorted(seen))
            raise ValueError(f"{where}: want photographs of one object in one bin each, got one of {shown}")
        for label, b in seen:
            if b >= 0:
                cells.setdefault((label, b), []).append(row)
    return cells


def _bins(images: LabelledImages, row: int) -> list[int]:
    own = images.bins[row]
    return own.expand(images.labels.shape[1]).tolist() if own.ndim == 0 else own.tolist()


def most(p: Sequence[float], available: Sequence[int], generator: torch.Generator) -> list[int] | None:
    """Return the counts of the largest ``apportioned`` choice that is available; None if there is none."""
    for total in range(sum(available), 0, -1):
        counts = apportioned(p, total, available, generator)
        if counts is not None:
            return counts
    return None


def apportioned(
    p: Sequence[float], total: int, available: Sequence[int], generator: torch.Generator
) -> list[int] | None:
    """Split ``total`` photographs among bins by largest remainders, each ``total * p`` rounded up or down.

    Among bins with equal remainders, those with enough photographs are rounded up first, in random order.

    Returns:
        The number in each bin; None if a bin has too few photographs.
    """
    quotas = [total * value for value in p]
    counts = [math.floor(quota + 1e-9) for quota in quotas]
    rest = [round(quota - count, 9) for quota, count in zip(quotas, counts, strict=True)]
    enough = [count < limit for count, limit in zip(counts, available, strict=True)]
    ties = torch.randperm(len(p), generator=generator).tolist()
    order = sorted(range(len(p)), key=lambda b: (-rest[b], not enough[b], ties[b]))
    for b in order[: total - sum(counts)]:
        counts[b] += 1
    return counts if all(c <= limit for c, limit in zip(counts, available, strict=True)) else None
