"""The space of a captured scene: centred on its object, contracted to a finite ball, and sampled along rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.objects.placing import nearest_to_axes

NEAR = 0.4
"""Start of rays, as a fraction of their camera's distance from the origin. Closer to the cameras, a field could place
a separate picture in front of each, and photographs of an object show nothing there."""
FAR = 100.0
"""End of rays: everything farther is contracted into a shell of thickness 1 / FAR."""


@dataclass(frozen=True)
class Frame:
    """The capture's frame, shifted by -``centre`` and then divided by ``unit``, both in the capture's unit."""

    centre: tuple[float, float, float]
    unit: float

    def into(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform points of the capture's frame into the normalised frame."""
        return (points - points.new_tensor(self.centre)) / self.unit

    def of(self, other: Frame, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform points of another normalised frame into this one."""
        moved = (points.new_tensor(other.centre) - points.new_tensor(self.centre)) / self.unit
        return points * (other.unit / self.unit) + moved

    def out(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Invert ``into``."""
        return points * self.unit + np.array(self.centre)


def contract(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Contract space to the ball of radius 2, the unit ball unchanged (mip-NeRF 360, Barron et al. 2022, Eq. 10)."""
    length = points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return points * ((2.0 - 1.0 / length) / length)


def expand(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Invert ``contract``; points outside the ball of radius 2 are sent far away."""
    length = points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return points / (length * (2.0 - length).clamp_min(1e-6))


def along_rays(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    phase: Float[Tensor, "rays"],
    count: int,
) -> tuple[Float[Tensor, "rays count 3"], Float[Tensor, "rays count"]]:
    """Return contracted positions of ``count`` samples of each ray, and the contracted length that each represents.

    Distances are equiangular about the origin (Kulla and Fajardo 2012): t = m + h tan(theta) with equal steps of theta,
    where m is the distance to the ray's point nearest to the origin and h^2 is 1 plus the square of that point's
    distance from the origin. The unit ball therefore has most samples, and steps grow as the contraction shrinks them.
    ``phase``, in [0, 1), shifts each ray's samples.
    """
    middle = -(origins * directions).sum(-1)
    square = origins.square().sum(-1)
    height = (1.0 + (square - middle.square()).clamp_min(0.0)).sqrt()
    first = torch.atan((NEAR * square.sqrt() - middle) / height)
    last = torch.atan((FAR - middle) / height)
    step = torch.arange(count + 1, device=phase.device, dtype=phase.dtype)
    theta = first[:, None] + (last - first)[:, None] * ((step + phase[:, None]) / (count + 1))
    distance = middle[:, None] + height[:, None] * torch.tan(theta)
    ends = contract(origins[:, None] + directions[:, None] * distance[..., None])
    return 0.5 * (ends[:, 1:] + ends[:, :-1]), (ends[:, 1:] - ends[:, :-1]).norm(dim=-1)


def cells_of(contracted: Float[Tensor, "*n 3"], resolution: int) -> Int[Tensor, "*n"]:
    """Return flat indices of the cells that contain points; ``resolution`` cells along each side of [-2, 2]^3."""
    place = ((contracted + 2.0) * (resolution / 4.0)).long().clamp_(0, resolution - 1)
    return (place[..., 0] * resolution + place[..., 1]) * resolution + place[..., 2]


def looked_at(camera_to_world: Float[np.ndarray, "n 4 4"], name: str) -> tuple[np.ndarray, float]:
    """Find the point nearest to the cameras' optical axes (least squares), and the cameras' median distance from it.

    Raises:
        ValueError: all axes are parallel, or the point is behind most cameras.
    """
    axes, centres = -camera_to_world[:, :3, 2], camera_to_world[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal, point = across.sum(0), nearest_to_axes(camera_to_world)
    ahead = ((point - centres) * axes).sum(1) > 0.0
    if np.linalg.eigvalsh(normal)[0] < 1e-3 * len(axes) or ahead.mean() < 0.5:
        raise ValueError(
            f"objects.masks=scene: the cameras of {name} do not look at one place from several sides, so the "
            "place of the object is unknown; set objects.box"
        )
    return point, float(np.median(np.linalg.norm(centres - point, axis=1)))
