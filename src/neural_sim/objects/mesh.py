"""A mesh normalised to the unit sphere, with the transform back to its source."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual import ColorVisuals, TextureVisuals

DEGENERATE_EXTENT = 1e-9


@dataclass(frozen=True)
class ObjectMesh:
    """A mesh whose bounding box is centred on the origin and whose farthest vertex has norm 1; +z up.

    ``transform`` maps normalised coordinates to the source's frame, in metres. ``digest`` is the SHA-256 of the
    object's source, which is part of the keys of stored results.
    """

    name: str
    mesh: trimesh.Trimesh
    transform: Float[np.ndarray, "4 4"]
    digest: str

    @property
    def radius(self) -> float:
        """Radius of the object's bounding sphere, in metres."""
        return float(abs(np.linalg.det(self.transform[:3, :3])) ** (1.0 / 3.0))


class Source(Protocol):
    """A source of objects, such as a folder."""

    def names(self) -> list[str]:
        """Return the objects' names."""
        ...

    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of each object's content, by name."""
        ...


class MeshSource(Source, Protocol):
    """A source of meshes; ``metric`` says whether they are in metres or have no unit of length."""

    metric: ClassVar[bool]

    def load(self) -> list[ObjectMesh]:
        """Read the objects."""
        ...


def normalise(mesh: trimesh.Trimesh, name: str, source: str, digest: str | None = None) -> ObjectMesh:
    """Copy ``mesh`` (in metres), centre its bounding box on the origin, and scale it to fit the unit sphere.

    ``source`` (a file or another origin) is used in messages. Without ``digest`` the mesh is hashed.

    Raises:
        ValueError: the mesh has no vertices, or its extent is zero or not finite.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if len(vertices) == 0 or not np.isfinite(vertices).all():
        raise ValueError(
            f"{source}: want finite vertices, got {'some that are not' if len(vertices) else 'none'}"
        )
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    if radius < DEGENERATE_EXTENT:
        raise ValueError(f"{source}: want a mesh with extent, got one of radius {radius:g}")
    scaled = mesh.copy()
    # Shifting and scaling keep normals, but trimesh would drop the file's.
    normals = np.array(mesh.vertex_normals)
    scaled.vertices = (vertices - centre) / radius
    scaled.vertex_normals = normals
    transform = np.eye(4)
    transform[:3, :3] *= radius
    transform[:3, 3] = centre
    return ObjectMesh(name, scaled, transform, digest or content_digest(mesh))


def content_digest(mesh: trimesh.Trimesh) -> str:
    """Return the SHA-256 of vertices, faces and colours or texture, the same on every machine."""
    state = hashlib.sha256()
    state.update(np.ascontiguousarray(np.round(mesh.vertices, 9), dtype="<f8").tobytes())
    state.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    visual = mesh.visual
    if isinstance(visual, TextureVisuals):
        image = getattr(visual.material, "image", None)
        if image is not None:
            state.update(np.ascontiguousarray(visual.uv, dtype="<f8").tobytes())
            state.update(np.asarray(image.convert("RGB")).tobytes())
    elif isinstance(visual, ColorVisuals) and visual.kind is not None:
        colours = visual.face_colors if visual.kind == "face" else visual.vertex_colors
        state.update(np.ascontiguousarray(colours).tobytes())
    return state.hexdigest()
