"""Read PLY files, with textures mapped by vertex or by corner, or with colours of vertices or faces."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from neural_sim.objects.paint import GREY, Part, find_named, read_texture
from neural_sim.objects.ply_elements import Element, read_elements
from neural_sim.objects.polygons import clipped

_log = logging.getLogger(__name__)

_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_CORNERS = ("vertex_indices", "vertex_index")


def ply_references(path: Path) -> list[Path]:
    """Return the textures to which a PLY file refers.

    Raises:
        ValueError: a texture is missing.
    """
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0].decode("utf-8", "replace")
    found = []
    for written in re.findall(
        r"^comment[ \t]+TextureFile:?[ \t]+(.+?)\s*$", head, re.MULTILINE | re.IGNORECASE
    ):
        texture = find_named(written, path.parent)
        if texture is None:
            raise ValueError(
                f"the texture {written!r} was not found; put it next to the file or remove the comment TextureFile"
            )
        found.append(texture)
    return found


def read_ply(path: Path) -> list[Part]:
    """Read the parts of a PLY file, one for each texture.

    Raises:
        ValueError: the file cannot be read, or a texture is missing.
    """
    textures = ply_references(path)
    elements = read_elements(path)
    vertex, face = elements.get("vertex"), elements.get("face")
    vertices = _stacked(vertex, ("x", "y", "z"))
    if vertex is None or vertices is None or face is None or not face.count:
        raise ValueError("has no vertices with x, y, z, or no faces")
    corners, origin = _triangles(face, vertices)
    model = _Model(vertices, _stacked(vertex, ("nx", "ny", "nz")), corners, origin)
    uv = _coordinates(vertex, face, model)
    if textures and uv is not None:
        if (colours := _colours(vertex)) is not None and (colours != 1.0).any():
            _log.warning("%s: has a texture and vertex colours; the colours are left out", path)
        return _textured(model, uv, textures, face)
    if textures:
        _log.warning("%s: has a texture but no texture coordinates; drawn without the texture", path)
    if (colours := _colours(vertex)) is not None:
        return [Part(vertices, corners, colours, model.normals)]
    if (colours := _colours(face)) is not None:
        return [Part(vertices, corners, colours[origin[:, 0]], model.normals, by_face=True)]
    _log.warning("%s: has no colours; painted grey", path)
    return [Part(vertices, corners, np.full((len(vertices), 3), GREY[0] / 255.0), model.normals)]


@dataclass(frozen=True, eq=False)
class _Model:
    """Triangles; ``origin`` has, for each, the polygon it was cut from and the places of its corners in it."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"] | None
    corners: Int[np.ndarray, "f 3"]
    origin: Int[np.ndarray, "f 4"]


def _triangles(
    face: Element, vertices: Float[np.ndarray, "v 3"]
) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, "f 4"]]:
    name = next((name for name in _CORNERS if name in face.columns), None)
    if name is None:
        raise ValueError(f"its faces have no {_CORNERS[0]}")
    polygons = face.columns[name]
    for polygon in [polygons.reshape(-1)] if polygons.dtype != object else polygons:
        if len(polygon) and not 0 <= polygon.min() <= polygon.max() < len(vertices):
            raise ValueError(
                f"a face refers to vertex {polygon.max()} or {polygon.min()}, but there are {len(vertices)}"
            )
    if polygons.dtype != object and polygons.shape[1] == 3:
        places = np.broadcast_to(np.arange(3), (len(polygons), 3))
        return polygons.astype(np.int64), np.concatenate([np.arange(len(polygons))[:, None], places], -1)
    made = [
        (number, *triangle)
        for number, polygon in enumerate(polygons)
        if len(polygon) >= 3
        for triangle in clipped(vertices[polygon])
    ]
    if not made:
        raise ValueError("its faces have fewer than three corners")
    origin = np.array(made, dtype=np.int64)
    return np.array([polygons[row[0]][row[1:]] for row in origin], dtype=np.int64), origin


def _coordinates(vertex: Element, face: Element, model: _Model) -> Float[np.ndarray, "f 3 2"] | None:
    """Return texture coordinates of each corner: those of its polygon, or else those of its vertex."""
    if "texcoord" in face.columns:
        stated = face.columns["texcoord"]
        made = np.zeros((*model.corners.shape, 2))
        for row, (number, *places) in enumerate(model.origin.tolist()):
            pairs = np.asarray(stated[number], dtype=np.float64)
            if len(pairs) % 2 or len(pairs) < 2 * (max(places) + 1):
                raise ValueError(f"face {number} has {len(pairs)} texcoord numbers, want two for each corner")
            made[row] = pairs.reshape(-1, 2)[places]
        return made
    for names in _COORDINATES:
        values = _stacked(vertex, names)
        if values is not None:
            return values[model.corners]
    return None


def _textured(
    model: _Model, uv: Float[np.ndarray, "f 3 2"], textures: Sequence[Path], face: Element
) -> list[Part]:
    number = np.zeros(len(model.corners), dtype=np.int64)
    if len(textures) > 1:
        if "texnumber" not in face.columns:
            raise ValueError(f"has {len(textures)} textures, but no texnumber says which face has which")
        number = face.columns["texnumber"][model.origin[:, 0]].astype(np.int64)
        if not ((number >= 0) & (number < len(textures))).all():
            raise ValueError(
                f"texnumber goes from {number.min()} to {number.max()}, but there are {len(textures)} textures"
            )
    parts = []
    for index in np.unique(number).tolist():
        of = number == index
        # A vertex is split if it has several texture coordinates.
        rows = np.concatenate([model.corners[of].reshape(-1, 1), uv[of].reshape(-1, 2)], -1)
        unique, faces = np.unique(rows, axis=0, return_inverse=True)
        at, white = unique[:, 0].astype(np.int64), np.ones((len(unique), 3))
        texture = read_texture(textures[index], f"texture {textures[index]}")
        own = None if model.normals is None else model.normals[at]
        parts.append(Part(model.vertices[at], faces.reshape(-1, 3), white, own, unique[:, 1:], texture))
    return parts


def _stacked(element: Element | None, names: Sequence[str]) -> Float[np.ndarray, "n m"] | None:
    if element is None or any(name not in element.columns for name in names):
        return None
    return np.stack([element.columns[name] for name in names], -1).astype(np.float64)


def _colours(element: Element) -> Float[np.ndarray, "n 3"] | None:
    """Return colours in [0, 1]; white is 65535 for ushort, 1 for floats up to 1, and 255 for everything else."""
    for names in _COLOURS:
        values = _stacked(element, names)
        if values is None:
            continue
        kind = next(item.kind for item in element.properties if item.name == names[0])
        white = {"u1": 255.0, "u2": 65535.0}.get(kind.str[1:], 1.0 if kind.kind == "f" else 255.0)
        if kind.kind == "f" and (values > 1.0).any():
            white = 255.0
        if not (np.isfinite(values).all() and (values >= 0.0).all() and (values <= white).all()):
            raise ValueError(f"want {', '.join(names)} from 0 to {white:g}")
        return values / white
    return None
