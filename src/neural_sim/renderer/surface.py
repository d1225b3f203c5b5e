"""Surfaces for both mesh renderers: triangles with their albedo and the light on either side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from neural_sim.objects.paint import Paint, Texture
from neural_sim.renderer.lighting import Lighting, lambert


@dataclass(frozen=True)
class Surface:
    """A mesh with baked light: its colour is albedo times shade at each vertex, interpolated, times any texture.

    Light is fixed in the object's frame, so the shade does not depend on the view, and renderers need not agree on
    lights or materials. The shade is ``front`` where a face is seen from outside, ``back`` where it is seen from inside
    (open and badly wound meshes). ``albedo`` is in [0, 1]. ``page`` is the index of each face's texture, -1: none.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    albedo: Float[np.ndarray, "v 3"]
    front: Float[np.ndarray, "v 3"]
    back: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    page: Int[np.ndarray, "f"]
    textures: tuple[Texture, ...]


def shaded_surface(mesh: trimesh.Trimesh, lighting: Lighting) -> Surface:
    """Read geometry, colours and textures from a mesh, and shade it.

    Raises:
        ValueError: the mesh has no faces, its vertices or normals are not finite (``neural_sim.objects.repair`` mends
            them), or its visual is neither of colours nor of textures.
    """
    if len(mesh.faces) == 0:
        raise ValueError("renderer: the mesh has no faces")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    normals = np.asarray(mesh.vertex_normals, dtype=np.float64)
    if not (np.isfinite(vertices).all() and np.isfinite(normals).all()):
        raise ValueError("renderer: the mesh has vertices or normals that are not finite; repair it first")
    faces = np.asarray(mesh.faces, dtype=np.int64)
    visual = mesh.visual
    uv, page, textures = np.zeros((len(vertices), 2)), np.full(len(faces), -1), ()
    if isinstance(visual, ColorVisuals) and visual.kind == "face":  # corners can no longer be shared
        albedo = np.repeat(np.asarray(visual.face_colors)[:, :3] / 255.0, 3, axis=0)
        vertices, normals = vertices[faces].reshape(-1, 3), normals[faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
        uv = np.zeros((len(vertices), 2))
    elif isinstance(visual, Paint):
        albedo, uv, page, textures = visual.albedo, visual.uv, visual.page[faces[:, 0]], visual.textures
    elif isinstance(visual, TextureVisuals):
        albedo, texture = _textured(visual, len(vertices))
        if texture is not None:
            uv, page, textures = np.asarray(visual.uv, dtype=np.float64), np.zeros_like(page), (texture,)
    elif isinstance(visual, ColorVisuals):
        albedo = np.asarray(visual.vertex_colors)[:, :3] / 255.0
    else:
        raise ValueError(f"renderer: want a mesh with colours or a texture, got {type(visual).__name__}")
    front, back = lambert(normals, lighting), lambert(-normals, lighting)
    return Surface(vertices, faces, albedo, front, back, uv, page, textures)


def _textured(visual: TextureVisuals, count: int) -> tuple[np.ndarray, Texture | None]:
    """Return albedo and texture; a material without an image has a single colour."""
    material = visual.material
    image, factor = getattr(material, "image", None), np.ones(3)
    if isinstance(material, PBRMaterial):
        image = material.baseColorTexture
        if material.baseColorFactor is not None:
            factor = np.asarray(material.baseColorFactor)[:3] / 255.0
    if isinstance(image, Image.Image) and visual.uv is not None and len(visual.uv) == count:
        return np.broadcast_to(factor, (count, 3)), Texture(np.asarray(image.convert("RGB")))
    colour = np.asarray(material.main_color)[:3] / 255.0
    return np.broadcast_to(colour, (count, 3)), None
