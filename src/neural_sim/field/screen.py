"""Find the pixels that can see occupied space, and at which distances, by projecting coarse cells."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.field.base import Span
from neural_sim.field.occupancy import COARSENING, Occupancy
from neural_sim.types import PinholeCamera

BLOCKS = 4
"""Least number of pixel blocks from a large ball's centre to its edge: larger blocks would include rays far from it."""


def coarse_centres(occupancy: Occupancy) -> tuple[Float[Tensor, "3 cells"], float]:
    """Return the centres of the occupied coarse cells and the radius of a ball around each, in object radii."""
    edge = COARSENING * occupancy.cell
    where = (occupancy.distance == 0).nonzero().t().to(occupancy.origin)
    return occupancy.origin[:, None] + (where + 0.5) * edge, 0.5 * math.sqrt(3.0) * edge


@torch.no_grad()
def screen_span(
    centres: Float[Tensor, "3 cells"],
    radius: float,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "4 4"],
    rows: range,
) -> Span:
    """Return distances between which rays of the image's ``rows`` can meet balls of ``radius`` around ``centres``.

    The interval is never too narrow; near > far if a pixel sees no ball. Each ball is drawn as the block of pixels at
    its centre, with its nearest and farthest distance; all are then widened on each side by as many blocks as the
    largest ball's radius covers. Blocks grow with the balls, so that a large image needs no more memory than a small
    one. If a ball touches the camera plane or covers more than the image, every pixel gets all distances.
    """
    rotation, position = camera_to_world[:3, :3], camera_to_world[:3, 3]
    x, y, z = (rotation.t() @ (centres - position[:, None])).unbind(0)
    size = (len(rows), camera.width)
    # A margin for rounding errors, far smaller than a step.
    radius = radius * (1.0 + 1e-4)
    # A point of the ball projects to (x + u) / (-z + w), |u|, |w| <= radius: off the centre by at most this slope.
    across, down = x / -z, -y / -z
    slope = radius * (1.0 + torch.maximum(across.abs(), down.abs())) / (-z - radius)
    ahead, largest = torch.stack([(-z > 1.01 * radius).all().to(slope.dtype), slope.amax()]).tolist()
    largest = largest if ahead else math.inf
    (fx, fy), (cx, cy) = focal_lengths(camera), principal_point(camera)
    focal = max(fx, fy)
    if focal * largest > max(camera.width, camera.height):
        whole = x.new_zeros(size[0] * size[1])
        return Span(whole, whole + math.inf)
    reach = math.ceil(focal * largest + 0.5)
    block = max(1, reach // BLOCKS)
    margin = math.ceil(reach / block)
    high, wide = (math.ceil(pixels / block) + 2 * margin for pixels in size)
    column = ((fx * across + cx) / block + margin).clamp(0, wide - 1)
    row = ((fy * down + (cy - rows.start)) / block + margin).clamp(0, high - 1)
    cell = torch.add(column.long(), row.long(), alpha=wide)
    distance = torch.sqrt(x * x + y * y + z * z)
    bounds = x.new_full((2, high * wide), -math.inf)
    bounds[0].scatter_reduce_(0, cell, radius - distance, "amax")
    bounds[1].scatter_reduce_(0, cell, radius + distance, "amax")
    pooled = _sliding_max(_sliding_max(bounds.view(2, high, wide), 1, 2 * margin + 1), 2, 2 * margin + 1)
    for axis, pixels in enumerate(size, start=1):
        pooled = pooled.index_select(axis, torch.arange(pixels, device=x.device) // block)
    near, far = pooled.flatten(1)
    return Span(-near, far)


def _sliding_max(values: Float[Tensor, "2 h w"], axis: int, width: int) -> Float[Tensor, "2 h2 w2"]:
    """Return the largest of every ``width`` neighbours along an axis, by doubling windows (faster than pooling)."""
    window = 1
    while 2 * window <= width:
        values = _larger(values, axis, window)
        window *= 2
    return _larger(values, axis, width - window)


def _larger(values: Float[Tensor, "2 h w"], axis: int, shift: int) -> Float[Tensor, "2 h2 w2"]:
    if not shift:
        return values
    rest = values.shape[axis] - shift
    return torch.maximum(values.narrow(axis, 0, rest), values.narrow(axis, shift, rest))
