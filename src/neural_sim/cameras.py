"""Cameras on the object's orbit, and the rays of their pixels. OpenGL axes: x right, y up, view along -z."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.types import PinholeCamera, Rays


def orbit(
    phi: Float[Tensor, "*n"], rho: Float[Tensor, "*n"], distance: Float[Tensor, "*n"]
) -> Float[Tensor, "*n 4 4"]:
    """Camera-to-world poses that look at the origin, differentiable in all three arguments.

    The object stands upright along world +z. ``phi`` goes once round the great circle through the poles: 0 above,
    pi/2 beside (world +x), pi below, 3 pi/2 on the other side (world -x). ``rho`` turns that circle about the
    vertical axis. Angles in radians, distance in object radii. The up vector is carried along the circle (it is
    the derivative of position by -phi), so nothing is singular at the poles, where a world-up ``look_at`` is.
    """
    sin_phi, cos_phi, sin_rho, cos_rho = phi.sin(), phi.cos(), rho.sin(), rho.cos()
    backward = torch.stack([sin_phi * cos_rho, sin_phi * sin_rho, cos_phi], -1)
    up = torch.stack([-cos_phi * cos_rho, -cos_phi * sin_rho, sin_phi], -1)
    right = torch.stack([-sin_rho, cos_rho, torch.zeros_like(rho)], -1)
    pose = torch.stack([right, up, backward, backward * distance[..., None]], -1)
    bottom = torch.zeros_like(pose[..., :1, :])
    bottom[..., 0, 3] = 1.0
    return torch.cat([pose, bottom], -2)


def focal_length(camera: PinholeCamera) -> float:
    """Focal length in pixels."""
    return 0.5 * camera.height / math.tan(0.5 * camera.field_of_view)


def magnified(camera: PinholeCamera, magnification: float) -> PinholeCamera:
    """The camera with ``magnification`` times its focal length."""
    return replace(
        camera, field_of_view=2.0 * math.atan(math.tan(0.5 * camera.field_of_view) / magnification)
    )


def pixel_directions(
    camera: PinholeCamera, *, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "height width 3"]:
    """Unit directions of the pixel centres in the camera's own frame; row 0 is the top of the image."""
    focal = focal_length(camera)
    x = (torch.arange(camera.width, dtype=dtype, device=device) + 0.5 - 0.5 * camera.width) / focal
    y = (torch.arange(camera.height, dtype=dtype, device=device) + 0.5 - 0.5 * camera.height) / focal
    rows, columns = torch.meshgrid(-y, x, indexing="ij")
    directions = torch.stack([columns, rows, -torch.ones_like(rows)], -1)
    return directions / directions.norm(dim=-1, keepdim=True)


def rays(camera: PinholeCamera, camera_to_world: Float[Tensor, "*n 4 4"]) -> Rays:
    """Rays through every pixel centre: shapes (*n, height, width, 3), differentiable in the pose."""
    local = pixel_directions(camera, dtype=camera_to_world.dtype, device=camera_to_world.device)
    rotation, position = camera_to_world[..., :3, :3], camera_to_world[..., :3, 3]
    directions = torch.einsum("...ij,hwj->...hwi", rotation, local)
    return Rays(position[..., None, None, :].expand_as(directions), directions)


def unit_sphere_span(
    bundle: Rays, radius: float = 1.0
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
    """Entry and exit distances of the sphere about the origin; entry >= exit where a ray misses it.

    A camera inside the sphere enters at distance 0.
    """
    along = -(bundle.origins * bundle.directions).sum(-1)
    closest = bundle.origins + along[..., None] * bundle.directions
    half_chord_squared = radius**2 - closest.square().sum(-1)
    half_chord = half_chord_squared.clamp_min(0.0).sqrt()
    near = (along - half_chord).clamp_min(0.0)
    far = torch.where(half_chord_squared > 0.0, along + half_chord, torch.full_like(along, -1.0))
    return near, far.clamp_min(0.0)
