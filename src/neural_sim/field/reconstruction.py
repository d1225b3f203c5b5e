"""A coloured mesh of an object from its posed views: marching cubes of the masks, colours from the views.

`+experiment=sfm_vs_nerf` compares fields with it. Its geometry comes from silhouettes (Laurentini 1994), not from
structure from motion, which needs features that smooth objects lack.
"""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neural_sim.alpha import premultiplied
from neural_sim.cameras import focal_lengths, principal_point
from neural_sim.extras import require
from neural_sim.field.hull import visual_hull
from neural_sim.types import PosedViews

LEVEL = 0.5
"""Alpha of the silhouette's edge."""
GRAZING = 0.2
"""Smallest cosine between a surface's normal and the direction to a camera at which its view colours the surface."""
SHARPNESS = 4.0
"""Power of that cosine in the views' weights: frontal views show most detail."""
LIFT = 0.02
"""Height in object radii above the surface at which the ray to a camera begins."""


def reconstruct(views: PosedViews, resolution: int = 128) -> trimesh.Trimesh:
    """Return the surface where the least alpha over all views is ``LEVEL``, with a colour at each vertex.

    It is in the views' frame. Its colours are those of the views, including their light, so it is to be drawn unlit.
    ``resolution`` is that of ``visual_hull``; the alphas are sampled at the centres of its cells. A photograph does not
    carve cells that it does not show.

    Raises:
        ValueError: as for ``visual_hull``, or if no point's alpha exceeds ``LEVEL``.
    """
    occupied, origin, cell = visual_hull(views, resolution)
    where = occupied.nonzero()
    centres = origin + (where.to(origin.dtype) + 0.5) * cell
    volume = torch.zeros(occupied.shape, dtype=origin.dtype, device=origin.device)
    volume[where.unbind(1)] = least_alpha(views, centres)
    if not bool((volume > LEVEL).any()):
        raise ValueError(f"reconstruct: no point lies within the masks of all {len(views)} views")
    padded = functional.pad(volume, (1, 1, 1, 1, 1, 1)).cpu().double().numpy()  # closed at the grid's border
    require("photos", "meshes from silhouettes")
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(padded, LEVEL, spacing=(cell,) * 3)
    vertices += origin.cpu().double().numpy() - 0.5 * cell  # centre of the padding's first cell
    # Alpha is larger inside, so the faces may be wound inwards; normals must point outwards.
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    if mesh.volume < 0.0:
        mesh.invert()
    colours = _with_alpha(vertex_colours(mesh, views))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def least_alpha(views: PosedViews, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p"]:
    """Return the least alpha, bilinear, over the views that show each point; 1 if none does."""
    least = torch.ones(len(points), dtype=points.dtype, device=points.device)
    for index in range(len(views)):
        (values, seen) = _sampled(views, index, points)
        least = torch.where(seen, torch.minimum(least, values[:, 3]), least)
    return least


def vertex_colours(mesh: trimesh.Trimesh, views: PosedViews) -> Float[np.ndarray, "v 3"]:
    """Return the mean colour in [0, 1] over the views that see each vertex, weighted towards those that face it.

    Vertices that no view sees get the mean colour of the others.
    """
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    points = torch.from_numpy(vertices.copy()).to(views.camera_to_world)
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for index, pose in enumerate(views.camera_to_world.cpu().double().numpy()):
        away = pose[:3, 3] - vertices
        facing = (normals * away).sum(1) / np.linalg.norm(away, axis=1)
        values, seen = _sampled(views, index, points)
        rgba = values.cpu().double().numpy()
        rows = np.flatnonzero((facing > GRAZING) & seen.cpu().numpy() & (rgba[:, 3] > LEVEL))
        if len(rows):
            hidden = mesh.ray.intersects_any(vertices[rows] + LIFT * normals[rows], away[rows])
            rows = rows[~hidden]
        share = facing[rows] ** SHARPNESS
        total[rows] += share[:, None] * rgba[rows, :3] / rgba[rows, 3:]
        weight[rows] += share
    known = weight > 0.0
    colours = np.full((len(vertices), 3), 0.5)
    if known.any():
        colours[known] = total[known] / weight[known, None]
        colours[~known] = colours[known].mean(0)
    return colours.clip(0.0, 1.0)


def _sampled(
    views: PosedViews, index: int, points: Float[Tensor, "p 3"]
) -> tuple[Float[Tensor, "p 4"], Tensor]:
    """Return a view's premultiplied RGBA at the points, bilinear, and which points it shows."""
    camera, pose = views.camera, views.camera_to_world[index]
    (fx, fy), (cx, cy) = focal_lengths(camera), principal_point(camera)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = (-local[:, 2]).clamp_min(1e-6)
    x, y = fx * local[:, 0] / depth + cx, -fy * local[:, 1] / depth + cy
    seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height) & (local[:, 2] < 0)
    image = premultiplied(views.images[index].to(points))
    if views.known is not None:
        known = views.known[index]
        column, row = (
            v.floor().long() for v in (x.clamp(0, camera.width - 1), y.clamp(0, camera.height - 1))
        )
        seen = seen & known[row, column]
    place = torch.stack([2 * x / camera.width - 1, 2 * y / camera.height - 1], -1)
    values = functional.grid_sample(
        image.movedim(-1, 0)[None], place[None, None], align_corners=False, padding_mode="border"
    )
    return values[0, :, 0].T, seen


def _with_alpha(colours: Float[np.ndarray, "v 3"]) -> np.ndarray:
    rgba = np.concatenate([colours, np.ones((len(colours), 1))], 1)
    return (255.0 * rgba).round().astype(np.uint8)
