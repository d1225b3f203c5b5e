"""The plane on which an object stands, found among points of the scene's surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.field.scene.space import Frame

NEARBY = 1.0
"""Radius, in the normalised frame, of the ball whose points are searched for a plane."""
AROUND = 2.0
"""Radius of the ball whose points a known plane is refitted to; the object then fills the unit ball."""
HYPOTHESES = 1024
TILT = math.radians(40.0)
"""Largest angle between a plane's normal and up, which is only rough if it is the mean of the cameras' up vectors."""
LIKELY = math.radians(15.0)
"""Standard deviation of that angle: among planes with equally many points, the one with the smaller angle wins."""
PART = 0.08
"""Smallest fraction of the nearby points that must lie on a supporting plane."""
STANDING = 0.02
"""Smallest fraction of the nearby points that must stand on a supporting plane."""
CAMERAS = 0.9
"""Smallest fraction of the cameras that must be above a supporting plane."""
SHOWING = 0.5
"""Largest ratio of points just below a supporting plane to points on it: a plane through an object has a larger one."""
ATTEMPTS = 4
JUST = 4.0
"""Points 1 to this many tolerances below a plane are evidence against it, because a support is opaque."""
BELOW = 4.0
"""Weight of points below the plane in its fit: surfaces without texture bulge towards the cameras, never away."""


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = offset, in the normalised frame; ``normal`` is of unit length and points up."""

    normal: tuple[float, float, float]
    offset: float

    def from_axis(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Return the points' distances from the line through the origin along the plane's normal."""
        normal = points.new_tensor(self.normal)
        return (points - (points @ normal)[..., None] * normal).norm(dim=-1)

    def moved(self, old: Frame, new: Frame) -> Plane:
        """Express the plane of the frame ``old`` in the frame ``new``."""
        normal = torch.tensor(self.normal, dtype=torch.float64)
        return Plane(self.normal, float(normal @ new.of(old, self.offset * normal)))

    def height(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Return the heights of points above the plane."""
        return points @ points.new_tensor(self.normal) - self.offset


def supporting_plane(
    points: Float[Tensor, "n 3"],
    up: Float[Tensor, "3"],
    cameras: Float[Tensor, "m 3"],
    tolerance: float,
    generator: torch.Generator,
) -> Plane | None:
    """Find the plane below the object at the origin; None if there is none. All inputs are in the normalised frame.

    RANSAC (Fischler and Bolles 1981) finds, from random samples of three points, the plane with the most points within
    ``tolerance`` and few just below it, which is then fitted by least squares. Most cameras must be above it, and
    something must stand on it near the origin. The plane must extend farther than what stands on it; the top of a box
    or the foot of a lamp does not.
    """
    near = points[points.norm(dim=-1) < NEARBY].double()
    left = torch.ones(len(near), dtype=torch.bool)
    for _ in range(ATTEMPTS):
        if int(left.sum()) < max(3.0, PART * len(near)):
            return None
        plane = _best(near[left], up.double(), tolerance, generator)
        if plane is None:
            return None
        on = plane.height(near).abs() < tolerance
        if _supports(plane, near, on, cameras, tolerance):
            return plane
        left &= ~on
    return None


def refitted(plane: Plane, points: Float[Tensor, "n 3"], tolerance: float) -> Plane:
    """Refit a roughly known plane to its points by least squares, with tolerances that decrease to ``tolerance``."""
    near = points[points.norm(dim=-1) < AROUND].double()
    up = torch.tensor(plane.normal, dtype=torch.float64)
    for width in (4.0, 2.0, 1.0, 1.0, 1.0):
        plane = _fitted(plane, near, up, width * tolerance) or plane
    return plane


def _best(
    points: Float[Tensor, "n 3"], up: Float[Tensor, "3"], tolerance: float, generator: torch.Generator
) -> Plane | None:
    a, b, c = points[torch.randint(len(points), (3, HYPOTHESES), generator=generator)]
    normal = torch.linalg.cross(b - a, c - a)
    length = normal.norm(dim=-1)
    normal = normal / length.clamp_min(1e-12)[:, None]
    normal = normal * torch.sign(normal @ up)[:, None]
    tilt = torch.acos((normal @ up / up.norm()).clamp(-1.0, 1.0))
    refused = (tilt > TILT) | (length < 1e-9)
    offset = (normal * a).sum(-1)
    height = points @ normal.t() - offset
    votes = (height.abs() < tolerance).sum(0) - ((height < -tolerance) & (height > -JUST * tolerance)).sum(0)
    votes = (votes * torch.exp(-0.5 * (tilt / LIKELY).square())).masked_fill(refused, 0.0)
    best = int(votes.argmax())
    if float(votes[best]) < 3.0:
        return None
    plane = Plane(_numbers(normal[best]), float(offset[best]))
    for _ in range(5):
        plane = _fitted(plane, points, up, tolerance) or plane
    return plane


def _fitted(
    plane: Plane, points: Float[Tensor, "n 3"], up: Float[Tensor, "3"], tolerance: float
) -> Plane | None:
    """Fit a plane to the points within tolerance, with weight ``BELOW`` below it; None if fewer than three."""
    height = plane.height(points)
    near = height.abs() < tolerance
    on = points[near]
    if len(on) < 3:
        return None
    weight = torch.where(height[near] < 0.0, BELOW, 1.0).double()[:, None]
    middle = (weight * on).sum(0) / weight.sum()
    normal = torch.linalg.eigh((weight * (on - middle)).t() @ (on - middle)).eigenvectors[:, 0]
    normal = normal * torch.sign(normal @ up)
    return Plane(_numbers(normal), float(normal @ middle))


def _supports(
    plane: Plane,
    near: Float[Tensor, "n 3"],
    on: Bool[Tensor, "n"],
    cameras: Float[Tensor, "m 3"],
    tolerance: float,
) -> bool:
    height = plane.height(near)
    standing = near[(height > 2.0 * tolerance) & (near.norm(dim=-1) < 1.0)]
    if float(on.float().mean()) < PART or len(standing) < STANDING * len(near):
        return False
    if float((plane.height(cameras.double()) > 0.0).float().mean()) < CAMERAS:
        return False
    just_below = (height < -tolerance) & (height > -JUST * tolerance)
    if float(just_below.sum()) > SHOWING * float(on.sum()):
        return False
    return _spread(near[on], plane) > _spread(standing, plane)


def _spread(points: Float[Tensor, "n 3"], plane: Plane) -> float:
    """Return the root mean square distance, along the plane, from the points' centre."""
    moved = points - points.mean(0)
    return float(plane.from_axis(moved).square().mean().sqrt())


def _numbers(vector: Float[Tensor, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
