"""Photographs resampled as views of one camera: undistorted, each camera rotated towards the object's centre.

Rotating a camera about its centre and changing its intrinsics maps pixels to pixels whatever the scene (a homography).
Photographs of any size and lens therefore become views of one square camera that shows the whole object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from neural_sim.alpha import premultiplied
from neural_sim.cameras import focal_length, pixel_rays
from neural_sim.objects.capture import Frame
from neural_sim.objects.pictures import Pictures
from neural_sim.objects.placing import Placement
from neural_sim.types import PinholeCamera, PosedViews

MARGIN = 1.08
"""Width of the views relative to that of the object's bounding sphere."""
MOST_SAMPLES = 16
"""Largest number of samples along each side of a view's pixel."""


def shared_camera(poses: Float[np.ndarray, "n 4 4"], image_size: int, name: str) -> PinholeCamera:
    """Choose the square camera that shows the whole unit sphere from the nearest of these poses (object radii).

    Raises:
        ValueError: a camera is inside the sphere.
    """
    nearest = float(np.linalg.norm(poses[:, :3, 3], axis=-1).min())
    if nearest <= 1.02:
        raise ValueError(
            f"{name}: a camera {nearest:.3g} object radii from the object's middle is inside it; "
            "check the masks"
        )
    tangent = MARGIN / math.sqrt(nearest**2 - 1.0)
    return PinholeCamera(image_size, image_size, 2.0 * math.atan(tangent))


def turned_to_origin(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Turn the pose by the smallest rotation that makes it look at the origin; its position does not change."""
    position = pose[:3, 3]
    backward, target = pose[:3, 2], position / np.linalg.norm(position)
    axis = np.cross(backward, target)
    cosine = float(backward @ target)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turn = np.eye(3) + skew + skew @ skew / max(1.0 + cosine, 1e-9)
    turned = pose.copy()
    turned[:3, :3] = turn @ pose[:3, :3]
    return turned


def resample(
    pictures: Pictures, frames: Sequence[Frame], placement: Placement, image_size: int
) -> PosedViews:
    """Make views of these frames in the object's frame, in their order.

    A pixel is the mean of samples about as dense as the photograph's pixels; it is ``known`` if all of them lie in the
    photograph.
    """
    poses = np.stack([placement.pose(frame.camera_to_world) for frame in frames])
    camera = shared_camera(poses, image_size, pictures.capture.name)
    turned = np.stack([turned_to_origin(pose) for pose in poses])
    views = [
        _view(pictures.rgba(frame), frame, torch.from_numpy(pose), torch.from_numpy(new), camera)
        for frame, pose, new in zip(frames, poses, turned, strict=True)
    ]
    images, known = (torch.stack(part) for part in zip(*views, strict=True))
    return PosedViews(images, torch.from_numpy(turned).float(), camera, known=known)


def pixels_per_pixel(frame: Frame, camera: PinholeCamera) -> float:
    """Return how many of the photograph's pixels fit along the side of one pixel of the views."""
    return max(frame.lens.fx, frame.lens.fy) / focal_length(camera)


def _view(
    photo: Float[Tensor, "h w 4"], frame: Frame, pose: Tensor, turned: Tensor, camera: PinholeCamera
) -> tuple[Float[Tensor, "s s 4"], Bool[Tensor, "s s"]]:
    side = min(MOST_SAMPLES, max(1, math.ceil(pixels_per_pixel(frame, camera))))
    fine = PinholeCamera(side * camera.width, side * camera.height, camera.field_of_view)
    top, bottom, left, right = _window(frame, pose, turned, camera)
    height, width = side * (bottom - top), side * (right - left)
    rows = torch.arange(side * top, side * bottom)[:, None]
    grid, seen = _projected(
        frame, pose, turned, fine, rows * fine.width + torch.arange(side * left, side * right)
    )
    sampled = functional.grid_sample(
        premultiplied(photo).movedim(-1, 0)[None],
        grid.float().view(1, height, width, 2),
        padding_mode="border",
        align_corners=False,
    )
    sampled = sampled * seen.view(1, 1, height, width)
    pooled = functional.avg_pool2d(sampled, side)[0].movedim(0, -1)
    inside = functional.avg_pool2d(seen.view(1, 1, height, width).float(), side)[0, 0] > 1.0 - 1e-6
    alpha = pooled[..., 3:]
    colour = torch.where(alpha > 1e-4, pooled[..., :3] / alpha.clamp_min(1e-4), 0.0)
    image = torch.cat([colour, torch.where(alpha > 1e-4, alpha, 0.0)], -1).clamp(0.0, 1.0)
    view = photo.new_zeros(camera.height, camera.width, 4)
    known = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    view[top:bottom, left:right] = image * inside[..., None]
    known[top:bottom, left:right] = inside
    return view, known


def _window(frame: Frame, pose: Tensor, turned: Tensor, camera: PinholeCamera) -> tuple[int, int, int, int]:
    """Return (top, bottom, left, right) of the part of a view in which the photograph lies, with a pixel to spare.

    Only that part is sampled: a view that shows the whole object from nearby is many times as wide as the photograph.
    """
    _, seen = _projected(frame, pose, turned, camera, torch.arange(camera.width * camera.height))
    found = seen.view(camera.height, camera.width)
    ends = []
    for across, size in ((1, camera.height), (0, camera.width)):
        (lines,) = found.any(across).nonzero(as_tuple=True)
        first, last = (int(lines[0]), int(lines[-1])) if len(lines) else (0, 0)
        ends += [max(first - 1, 0), min(last + 2, size)]
    top, bottom, left, right = ends
    return top, bottom, left, right


def _projected(
    frame: Frame, pose: Tensor, turned: Tensor, camera: PinholeCamera, pixel: Tensor
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, "n"]]:
    """Return where pixels of a view lie in the photograph, from -1 to 1, and whether they lie in it."""
    directions = pixel_rays(camera, turned[None], pixel.flatten()).directions @ pose[:3, :3]
    place, seen = frame.lens.project(directions)
    size = place.new_tensor([frame.lens.width, frame.lens.height])
    seen &= ((place >= 0.0) & (place <= size)).all(-1)
    return (2.0 * place / size - 1.0).nan_to_num(2.0), seen
