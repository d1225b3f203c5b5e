"""Repair of meshes from files: degenerate faces, normals, colours."""

from __future__ import annotations

import copy
import logging

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from neural_sim.objects.paint import GREY, Paint

log = logging.getLogger(__name__)

HUGE_FACES = 500_000
LEAST_VERTICES = 50
"""Number of vertices below which a tip far from the others may be intended."""
OUTLIER = 1.5
"""Ratio of an outlier's distance from the middle to the next largest; YCB scans have up to 1.003."""


def repair(mesh: trimesh.Trimesh, name: str, source: str) -> trimesh.Trimesh:
    """Return a copy of a mesh that can be rendered, and warn about every repair.

    The copy has finite normals and colours, and no degenerate faces. If a normal is not finite or too short, all are
    recomputed from the faces. A mesh without colours, or with a missing texture, gets its material's colour or grey.
    More than ``HUGE_FACES`` faces only give a warning. Vertices that no face uses, common in the parts of glTF files,
    are dropped without a warning.

    Raises:
        ValueError: no face has positive area and finite vertices; the message begins with ``source``.
    """
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or len(mesh.vertices) == 0:
        raise ValueError(f"{source}: object {name!r} has no faces; want a triangle mesh")
    mesh = _without_bad_faces(mesh, name, source)
    _warn_of_outlier(np.asarray(mesh.vertices), name, source)
    if len(mesh.faces) > HUGE_FACES:
        log.warning(
            "%s: object %r has %d faces; more than %d are slow to draw: decimate the mesh if views take long",
            source, name, len(mesh.faces), HUGE_FACES,
        )  # fmt: skip
    mesh = _with_finite_normals(mesh, name, source)
    return _with_colour(mesh, name, source)


def _without_bad_faces(mesh: trimesh.Trimesh, name: str, source: str) -> trimesh.Trimesh:
    mesh = mesh.copy(include_cache=True)  # the file's normals are in the cache
    vertices = np.asarray(mesh.vertices)
    good = np.isfinite(vertices[mesh.faces].sum(axis=(1, 2)))
    if good.any():
        corners = vertices[mesh.faces]
        doubled = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        good = good & (np.nan_to_num(doubled) > 0.0)
    if not good.any():
        raise ValueError(f"{source}: object {name!r} has no face of positive area with finite vertices")
    if not good.all():
        log.warning(
            "%s: object %r: dropped %d of %d faces (no area or not finite)",
            source, name, int((~good).sum()), len(good),
        )  # fmt: skip
        mesh.update_faces(good)
    # Vertices without a face cannot be seen, but would count in the object's size.
    unused = len(vertices) - len(np.unique(mesh.faces))
    if unused:
        log.info("%s: object %r: dropped %d vertices without a face", source, name, unused)
        mesh.remove_unreferenced_vertices()
    return mesh


def _warn_of_outlier(vertices: Float[np.ndarray, "v 3"], name: str, source: str) -> None:
    """Warn about a single vertex far from all others (from a wrong digit, say), which would shrink the object."""
    away = np.linalg.norm(vertices - np.median(vertices, axis=0), axis=1)
    farthest = int(away.argmax())
    others = away[(vertices != vertices[farthest]).any(axis=1)]
    if len(vertices) >= LEAST_VERTICES and len(others) and away[farthest] > OUTLIER * others.max():
        log.warning(
            "%s: object %r: the vertex %s is %.3g times as far from the middle as any other; is a digit wrong?",
            source, name, vertices[farthest].tolist(), away[farthest] / others.max(),
        )  # fmt: skip


def _with_finite_normals(mesh: trimesh.Trimesh, name: str, source: str) -> trimesh.Trimesh:
    normals = np.asarray(mesh.vertex_normals)
    bad = ~np.isfinite(normals).all(1) | (np.linalg.norm(normals, axis=1) < 0.5)
    if not bad.any():
        return mesh
    log.warning(
        "%s: object %r: %d of %d normals are too short or not finite; all are recomputed",
        source, name, int(bad.sum()), len(bad),
    )  # fmt: skip
    # A new mesh has none of the file's normals, so trimesh computes them from the faces.
    rebuilt = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    rebuilt.visual = copy.deepcopy(mesh.visual)
    fresh = np.array(rebuilt.vertex_normals)
    lost = ~np.isfinite(fresh).all(1) | (np.linalg.norm(fresh, axis=1) < 0.5)
    fresh[lost] = (0.0, 0.0, 1.0)
    rebuilt.vertex_normals = fresh
    return rebuilt


def _with_colour(mesh: trimesh.Trimesh, name: str, source: str) -> trimesh.Trimesh:
    visual, paint = mesh.visual, GREY
    if isinstance(visual, Paint):
        visual.uv = _finite_uv(visual.uv, name, source)
        return mesh
    if isinstance(visual, TextureVisuals):
        material = visual.material
        image = (
            material.baseColorTexture
            if isinstance(material, PBRMaterial)
            else getattr(material, "image", None)
        )
        if image is not None and visual.uv is not None and len(visual.uv) == len(mesh.vertices):
            visual.uv = _finite_uv(np.asarray(visual.uv), name, source)
            return mesh
        if np.asarray(material.main_color)[:3].any():  # black means that the file gives no colour
            paint = tuple(int(value) for value in np.asarray(material.main_color)[:4])
        log.warning("%s: object %r: no texture (is it missing?); painted plain %s", source, name, paint[:3])
    elif isinstance(visual, ColorVisuals) and visual.kind in ("vertex", "face"):
        return mesh
    else:
        log.warning("%s: object %r has no colours; painted grey", source, name)
    colours = np.tile(np.array(paint, dtype=np.uint8), (len(mesh.vertices), 1))
    mesh.visual = ColorVisuals(mesh, vertex_colors=colours)
    return mesh


def _finite_uv(uv: Float[np.ndarray, "v 2"], name: str, source: str) -> Float[np.ndarray, "v 2"]:
    finite = np.all(np.isfinite(uv), axis=1)
    if not finite.all():
        log.warning(
            "%s: object %r: %d of %d texture coordinates are not finite; set to 0",
            source, name, int((~finite).sum()), len(uv),
        )  # fmt: skip
    return np.where(finite[:, None], uv, 0.0)
