"""What both mesh renderers draw: triangles, their albedo, and the light on both of their sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image

from neural_sim.renderer.lighting import Lighting, lambert


@dataclass(frozen=True)
class Surface:
    """A mesh with its light baked in: albedo times shade, both interpolated over each triangle, is the colour.

    The light and the object share one frame, so the shade belongs to the vertex and no renderer has to agree with
    another about lights or materials. ``front`` holds where a face is seen from outside, ``back`` from inside (open
    and badly wound meshes). ``albedo`` per vertex in [0, 1] is white where a ``texture`` carries the colour.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    albedo: Float[np.ndarray, "v 3"]
    front: Float[np.ndarray, "v"]
    back: Float[np.ndarray, "v"]
    uv: Float[np.ndarray, "v 2"] | None
    texture: UInt8[np.ndarray, "h w 3"] | None


def shaded_surface(mesh: trimesh.Trimesh, lighting: Lighting) -> Surface:
    """Read geometry, colours and texture out of a trimesh, whichever of its visual kinds holds them.

    Raises ``ValueError`` for a mesh without faces or with vertices or normals that are not finite
    (``neural_sim.objects.mesh.repair`` mends those).
    """
    if len(mesh.faces) == 0:
        raise ValueError("renderer: the mesh has no faces")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    normals = np.asarray(mesh.vertex_normals, dtype=np.float64)
    if not (np.isfinite(vertices).all() and np.isfinite(normals).all()):
        raise ValueError("renderer: the mesh has vertices or normals that are not finite; repair it first")
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if mesh.visual.kind == "face":  # one colour a face: corners can no longer be shared
        albedo = np.repeat(np.asarray(mesh.visual.face_colors)[:, :3] / 255.0, 3, axis=0)
        vertices, normals = vertices[faces].reshape(-1, 3), normals[faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
        uv = texture = None
    else:
        albedo, uv, texture = _albedo(mesh)
    front, back = lambert(normals, lighting), lambert(-normals, lighting)
    return Surface(vertices, faces, albedo, front, back, uv, texture)


def _albedo(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    visual = mesh.visual
    if visual.kind == "texture" and visual.uv is not None and len(visual.uv) == len(mesh.vertices):
        material = visual.material
        image = getattr(material, "image", None)
        factor = np.ones(3)
        if isinstance(material, trimesh.visual.material.PBRMaterial):
            image = material.baseColorTexture
            if material.baseColorFactor is not None:
                factor = np.asarray(material.baseColorFactor)[:3] / 255.0
        if isinstance(image, Image.Image):
            albedo = np.broadcast_to(factor, (len(mesh.vertices), 3))
            return albedo, np.asarray(visual.uv, dtype=np.float64), np.asarray(image.convert("RGB"))
    colours = visual.to_color() if visual.kind == "texture" else visual
    return np.asarray(colours.vertex_colors)[:, :3] / 255.0, None, None
