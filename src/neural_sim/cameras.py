"""Pinhole cameras, poses on an orbit about the object, and pixel rays. OpenGL axes: x right, y up, view along -z."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.types import PinholeCamera, Rays


def orbit(
    phi: Float[Tensor, "*n"], rho: Float[Tensor, "*n"], distance: Float[Tensor, "*n"], *, radius: float = 1.0
) -> Float[Tensor, "*n 4 4"]:
    """Compute camera-to-world poses that look at the origin, differentiable in all three arguments.

    The object stands upright along world +z. ``phi`` goes once round the great circle through the poles: 0 above,
    pi/2 beside (world +x), pi below, 3 pi/2 on the other side (world -x). ``rho`` turns that circle about the
    vertical axis. Angles are in radians, positions in object radii; ``distance`` has the unit of ``radius``, the
    object's radius (by default, object radii). The up vector is minus the derivative of the direction with respect to
    phi, so nothing is singular at the poles, unlike a ``look_at`` with world up.
    """
    sin_phi, cos_phi, sin_rho, cos_rho = phi.sin(), phi.cos(), rho.sin(), rho.cos()
    backward = torch.stack([sin_phi * cos_rho, sin_phi * sin_rho, cos_phi], -1)
    up = torch.stack([-cos_phi * cos_rho, -cos_phi * sin_rho, sin_phi], -1)
    right = torch.stack([-sin_rho, cos_rho, torch.zeros_like(rho)], -1)
    pose = torch.stack([right, up, backward, backward * (distance / radius)[..., None]], -1)
    bottom = torch.zeros_like(pose[..., :1, :])
    bottom[..., 0, 3] = 1.0
    return torch.cat([pose, bottom], -2)


def focal_length(camera: PinholeCamera) -> float:
    """Compute the vertical focal length in pixels."""
    return 0.5 * camera.height / math.tan(0.5 * camera.field_of_view)


def focal_lengths(camera: PinholeCamera) -> tuple[float, float]:
    """Compute the horizontal and vertical focal lengths in pixels."""
    vertical = focal_length(camera)
    return camera.aspect * vertical, vertical


def principal_point(camera: PinholeCamera) -> tuple[float, float]:
    """Locate the principal point (x, y), in pixels from the image's upper left corner: OpenCV's plus half a pixel."""
    return (0.5 * camera.width, 0.5 * camera.height) if camera.centre is None else camera.centre


def opencv_camera(
    width: int, height: int, fx: float, fy: float, cx: float | None = None, cy: float | None = None
) -> PinholeCamera:
    """Make the camera of an OpenCV camera matrix, in pixels.

    OpenCV's origin is the centre of the upper left pixel: ``cx`` of a centred camera is (width - 1) / 2, the default.

    Raises:
        ValueError: a size or focal length is not positive and finite.
    """
    if not (0.0 < fx < math.inf and 0.0 < fy < math.inf):
        raise ValueError(f"camera: fx and fy must be positive and finite, got {fx} and {fy}")
    centred = cx is None and cy is None
    across, down = (0.5 * side if c is None else c + 0.5 for side, c in ((width, cx), (height, cy)))
    field_of_view = 2.0 * math.atan(0.5 * height / fy)
    return PinholeCamera(width, height, field_of_view, fx / fy, None if centred else (across, down))


def resized(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    """Make the camera that takes this camera's images, resized to another width and height."""
    x, y = principal_point(camera)
    (fx, fy), across, down = focal_lengths(camera), width / camera.width, height / camera.height
    centre = None if camera.centre is None else (across * x, down * y)
    aspect = camera.aspect if width * camera.height == height * camera.width else across * fx / (down * fy)
    return PinholeCamera(width, height, camera.field_of_view, aspect, centre)


def reframed(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    """Make the camera of images of another size that contain this camera's whole image, centred and undistorted.

    If the aspect ratios differ, the new images show more along one of their sides.
    """
    scale = min(width / camera.width, height / camera.height)
    fy = scale * focal_length(camera)
    x, y = principal_point(camera)
    moved = (0.5 * width + scale * (x - 0.5 * camera.width), 0.5 * height + scale * (y - 0.5 * camera.height))
    centre = None if camera.centre is None else moved
    return PinholeCamera(width, height, 2.0 * math.atan(0.5 * height / fy), camera.aspect, centre)


def cropped(camera: PinholeCamera, left: int, top: int, width: int, height: int) -> PinholeCamera:
    """Make the camera of a crop of this camera's images, in pixels; the crop may reach beyond the images."""
    x, y = principal_point(camera)
    angle = 2.0 * math.atan(0.5 * height / focal_length(camera))
    return PinholeCamera(width, height, angle, camera.aspect, (x - left, y - top))


def turned(
    camera: PinholeCamera, camera_to_world: Float[Tensor, "4 4"], shift: tuple[float, float]
) -> Float[Tensor, "4 4"]:
    """Rotate a camera in place, so that what it shows at the principal point moves by ``shift`` pixels (right, down).

    The rotation is the smallest that does so. The direction from the object to the camera does not change.
    """
    fx, fy = focal_lengths(camera)
    ahead = camera_to_world.new_tensor([0.0, 0.0, -1.0])
    aim = camera_to_world.new_tensor([shift[0] / fx, -shift[1] / fy, -1.0])
    aim = aim / cast(Tensor, aim.norm())  # pyright: ignore[reportUnknownMemberType]
    # Rodrigues' formula for the rotation of ``ahead`` onto ``aim``, whose axis is their cross product.
    axis, cosine = torch.cross(ahead, aim, dim=-1), ahead @ aim
    x, y, z = axis.unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    turn = torch.eye(3, dtype=axis.dtype, device=axis.device) + skew + skew @ skew / (1.0 + cosine)
    moved = camera_to_world.clone()
    moved[:3, :3] = camera_to_world[:3, :3] @ turn.t()
    return moved


def magnified(camera: PinholeCamera, magnification: float) -> PinholeCamera:
    """Make the camera with ``magnification`` times its focal length."""
    return replace(
        camera, field_of_view=2.0 * math.atan(math.tan(0.5 * camera.field_of_view) / magnification)
    )


def cameras_of(
    camera: PinholeCamera, magnification: Float[Tensor, "n"] | None
) -> list[tuple[PinholeCamera, slice]]:
    """List cameras, each with its images: one for all images, or with ``magnification`` one for each image.

    ``magnification`` are the images' focal lengths in units of the camera's.
    """
    if magnification is None or len(magnification) == 0:
        return [(camera, slice(None))]
    sizes = cast(list[float], magnification.tolist())  # pyright: ignore[reportUnknownMemberType]
    return [(magnified(camera, size), slice(i, i + 1)) for i, size in enumerate(sizes)]


def pixel_rays(
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "*m views 4 4"],
    pixel: Int[Tensor, "rays"],
    magnification: Float[Tensor, "views"] | None = None,
) -> Rays:
    """Cast rays (*m, rays, 3) through the pixels' centres; ``pixel`` are flat indices into [views, height, width].

    Row 0 is the top of the image. Rays are linear in the poses and differentiable with respect to ``magnification``,
    the views' focal lengths in units of the camera's. All callers share this arithmetic: a rounding error that moves a
    sample to another cell changes its derivative.
    """
    per_view, (fx, fy), (cx, cy) = (
        camera.height * camera.width,
        focal_lengths(camera),
        principal_point(camera),
    )
    inside, view = pixel % per_view, torch.div(pixel, per_view, rounding_mode="floor")
    row = torch.div(inside, camera.width, rounding_mode="floor")
    x = ((inside % camera.width).to(camera_to_world.dtype) + 0.5 - cx) / fx
    y = (row.to(camera_to_world.dtype) + 0.5 - cy) / fy
    if magnification is not None:
        x, y = x / magnification[view], y / magnification[view]
    local = torch.stack([x, -y, -torch.ones_like(x)], -1)
    local = local / cast(Tensor, local.norm(dim=-1, keepdim=True))  # pyright: ignore[reportUnknownMemberType]
    pose = camera_to_world.index_select(-3, view)
    return Rays(pose[..., :3, 3], torch.einsum("...rij,rj->...ri", pose[..., :3, :3], local))


def rays(camera: PinholeCamera, camera_to_world: Float[Tensor, "*n 4 4"]) -> Rays:
    """Cast rays through every pixel centre: shapes (*n, height, width, 3), differentiable with respect to the pose."""
    poses = camera_to_world.reshape(-1, 4, 4)
    count = len(poses) * camera.height * camera.width
    bundle = pixel_rays(camera, poses, torch.arange(count, device=poses.device))
    shape = (*camera_to_world.shape[:-2], camera.height, camera.width, 3)
    return Rays(bundle.origins.view(shape), bundle.directions.view(shape))


def ray_rates(
    camera: PinholeCamera, rays: Rays, rates: Float[Tensor, "*m views 4 4"], pixel: Int[Tensor, "rays"]
) -> Rays:
    """Differentiate the rays (*m, rays, 3) of pixels, given the derivatives ``rates`` of the camera-to-world matrices.

    Directions keep unit length, so the component along them is removed: for a rotating camera it is a rounding error,
    for a changing focal length the derivative of the normalisation.
    """
    moved = pixel_rays(camera, rates, pixel)
    along = (moved.directions * rays.directions).sum(-1, keepdim=True)
    return Rays(moved.origins, moved.directions - along * rays.directions)


def unit_sphere_span(
    bundle: Rays, radius: float = 1.0
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
    """Find the distances along unit-length rays at which they enter and leave the sphere about the origin.

    Entry >= exit if the ray misses the sphere; entry is 0 if the origin lies inside.
    """
    along = -(bundle.origins * bundle.directions).sum(-1)
    closest = bundle.origins + along[..., None] * bundle.directions
    half_chord_squared = radius**2 - closest.square().sum(-1)
    half_chord = half_chord_squared.clamp_min(0.0).sqrt()
    near = (along - half_chord).clamp_min(0.0)
    far = torch.where(half_chord_squared > 0.0, along + half_chord, torch.full_like(along, -1.0))
    return near, far.clamp_min(0.0)
