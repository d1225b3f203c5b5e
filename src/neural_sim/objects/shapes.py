"""Closed parts with texture coordinates: solids of revolution, boxes and bent tubes. Normals point outward."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from neural_sim.objects.texture import Print, atlas


@dataclass(frozen=True)
class Part:
    """Triangles that share one printed panel; ``uv``, in [0, 1] of that panel, has v upwards."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "v 2"]
    panel: Print


def revolve(
    profile: list[tuple[float, float]], side: Print, cap: Print, segments: int = 64, rows: int = 6
) -> list[Part]:
    """Revolve a profile of (radius, z) about the z axis, with one part for each straight piece.

    The profile runs anticlockwise, seen with radius to the right and z up: from the bottom's centre outwards, up the
    side, back to the axis. Steep pieces are printed with ``side`` (x: azimuth, 0.5 at world +x and growing towards +y;
    y: height over the profile's range), flat ones with ``cap``, seen from outside (image right is +y).
    """
    heights = [z for _, z in profile]
    low, span = min(heights), max(max(heights) - min(heights), 1e-9)
    widest = max(radius for radius, _ in profile)
    angles = np.linspace(-np.pi, np.pi, segments + 1)
    parts = []
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        steep = abs(z1 - z0) > abs(r1 - r0)
        steps = np.linspace(0.0, 1.0, (rows if steep else 2) + 1)
        radius, z = r0 + steps * (r1 - r0), z0 + steps * (z1 - z0)
        x, y = radius[:, None] * np.cos(angles), radius[:, None] * np.sin(angles)
        grid = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1)
        if steep:
            u = np.broadcast_to((angles + np.pi) / (2.0 * np.pi), x.shape)
            v = np.broadcast_to(((z - low) / span)[:, None], x.shape)
        else:
            towards = -1.0 if r1 < r0 else 1.0  # seen from above, image up is -x; from below +x
            u, v = 0.5 + 0.5 * y / widest, 0.5 + 0.5 * towards * x / widest
        faces = _grid_faces(len(steps), segments + 1)
        parts.append(
            _part(grid.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2), side if steep else cap)
        )
    return parts


def box(
    low: tuple[float, float, float], high: tuple[float, float, float], panels: dict[str, Print]
) -> list[Part]:
    """Make an axis-aligned box; ``panels`` has a print for each of '+x', '-x', '+y', '-y', '+z', '-z'."""
    middle, half = 0.5 * np.add(low, high), 0.5 * np.subtract(high, low)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    parts = []
    for face, (right, up) in _FACE_AXES.items():
        outward = np.cross(right, up)
        directions = corners[:, :1] * np.array(right) + corners[:, 1:] * np.array(up) + outward
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        parts.append(Part(middle + directions * half, faces, 0.5 * (corners + 1.0), panels[face]))
    return parts


def tube(path: Float[np.ndarray, "n 3"], radius: float, panel: Print, sides: int = 16) -> list[Part]:
    """Make a round rod along a path in the x-z plane, closed at both ends."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.array([0.0, 1.0, 0.0])
    beside = np.cross(tangent, across)
    angles = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(angles)[None, :, None] * beside[:, None] + np.sin(angles)[None, :, None] * across
    point = 0.0 * ring[:1]  # a ring of radius zero closes each end
    rings = np.concatenate([path[:1, None] + point, path[:, None] + radius * ring, path[-1:, None] + point])
    u = np.broadcast_to(np.linspace(0.0, 1.0, sides + 1), rings.shape[:2])
    v = np.broadcast_to(np.linspace(0.0, 1.0, len(rings))[:, None], rings.shape[:2])
    faces = _grid_faces(len(rings), sides + 1)[:, ::-1]
    return [_part(rings.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2), panel)]


def assemble(parts: list[Part]) -> trimesh.Trimesh:
    """Join parts into one mesh with one texture."""
    panels: list[Print] = []
    for part in parts:
        if part.panel not in panels:
            panels.append(part.panel)
    image, places = atlas([panel.pixels() for panel in panels])
    vertices, faces, uv, count = [], [], [], 0
    for part in parts:
        scale, offset = places[panels.index(part.panel)]
        vertices.append(part.vertices)
        faces.append(part.faces + count)
        uv.append(part.uv * scale + offset)
        count += len(part.vertices)
    visual = TextureVisuals(uv=np.concatenate(uv), material=SimpleMaterial(image=image))
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)


# Image right and image up of each face of a box, as the orbit's camera sees it with the object upright (the top
# and bottom as phi = 0 and phi = pi see them).
_FACE_AXES = {
    "+x": ((0, 1, 0), (0, 0, 1)),
    "-x": ((0, -1, 0), (0, 0, 1)),
    "+y": ((-1, 0, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, 0, 1)),
    "+z": ((0, 1, 0), (-1, 0, 0)),
    "-z": ((0, 1, 0), (1, 0, 0)),
}


def _grid_faces(rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)


def _part(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, panel: Print) -> Part:
    """Make a part without the triangles that degenerate where a grid meets an axis."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = faces[area > 1e-12]
    used, flat = np.unique(kept, return_inverse=True)
    return Part(vertices[used], flat.reshape(-1, 3), uv[used], panel)
