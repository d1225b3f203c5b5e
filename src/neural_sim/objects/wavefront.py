"""Read OBJ files and their materials: Kd times map_Kd, each material on its own faces."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from neural_sim.objects.paint import GREY, Part, Texture, Wrap, find_named, read_texture
from neural_sim.objects.polygons import clipped

_log = logging.getLogger(__name__)

_FLAGS = {"-blendu": 1, "-blendv": 1, "-bm": 1, "-boost": 1, "-cc": 1, "-imfchan": 1, "-mm": 2, "-texres": 1}
"""Options of maps that have no effect here, and how many values follow them."""
_NO_MATERIAL = ("none", "(null)", "null", "default")
"""Names that writers use for faces without a material."""
Corner = tuple[int, int, int]
"""Indices, from 0, of a corner's vertex, texture coordinate and normal; -1: none."""


@dataclass
class Material:
    """A material of an MTL file: its colour, its texture's file, and the placement of the texture."""

    colour: tuple[float, float, float] | None = None
    texture: Path | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    wrap: Wrap = "repeat"


@dataclass
class _Model:
    """The lines of an OBJ file, split into words; ``faces`` has polygons by material."""

    vertices: list[list[str]] = field(default_factory=list)
    coordinates: list[list[str]] = field(default_factory=list)
    normals: list[list[str]] = field(default_factory=list)
    faces: dict[str | None, list[list[Corner]]] = field(default_factory=dict)


def obj_references(path: Path) -> list[Path]:
    """Return the files to which an OBJ file refers: its material libraries and their textures.

    Raises:
        ValueError: a texture is missing, or a library cannot be read.
    """
    libraries = _libraries(_text(path), path)
    textures = [material.texture for material in _materials(libraries).values()]
    return [*libraries, *dict.fromkeys(texture for texture in textures if texture is not None)]


def read_obj(path: Path) -> list[Part]:
    """Read the parts of an OBJ file: for each material, the faces with and those without texture coordinates.

    Raises:
        ValueError: a line cannot be read, an index points to nothing, or a material or texture is missing.
    """
    text = _text(path)
    libraries = _libraries(text, path)
    materials = _materials(libraries)
    model = _parse(text, path)
    vertices, colours = _positions(model, path)
    coordinates, normals = _numbers(model.coordinates, 1, "vt"), _numbers(model.normals, 3, "vn")
    textures: dict[tuple[Path, Wrap], Texture] = {}
    parts = []
    for name, polygons in model.faces.items():
        material = _material(name, materials, libraries, path, len(polygons), colours is not None)
        for corners in _uniform(_triangles(polygons, vertices)):
            _check_indices(corners, (len(vertices), len(coordinates), len(normals)))
            rows, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
            at, uv = rows[:, 0], None
            paint = np.ones((len(at), 3)) if colours is None else colours[at]
            texture = None
            if material.texture is not None and rows[0, 1] >= 0:
                key = (material.texture, material.wrap)
                if key not in textures:
                    textures[key] = read_texture(
                        material.texture, f"texture {material.texture}", (material.wrap, material.wrap)
                    )
                texture = textures[key]
                uv = _coordinates(coordinates)[rows[:, 1]] * material.scale + material.offset
            elif material.texture is not None:
                _log.warning(
                    "%s: %d faces of material %r have no coordinates in its texture %s and get its plain colour",
                    path, len(corners), name, material.texture.name,
                )  # fmt: skip
            if texture is not None or colours is None:
                paint = np.broadcast_to(_colour(material, texture, name, path), (len(at), 3))
            if texture is not None and colours is not None and (colours[at] != 1.0).any():
                _log.warning(
                    "%s: vertex colours of faces with the texture %s are left out", path, material.texture
                )
            own = normals[rows[:, 2]] if rows[0, 2] >= 0 else None
            parts.append(Part(vertices[at], faces.reshape(-1, 3), paint, own, uv, texture))
    return parts


def _colour(material: Material, texture: Texture | None, name: str | None, path: Path) -> np.ndarray:
    if texture is None:
        if material.colour is not None:
            return np.array(material.colour)
        _log.warning("%s: material %r has no colour; painted grey", path, name)
        return np.array(GREY[:3]) / 255.0
    if material.colour is None or not any(material.colour):
        if material.colour is not None:
            _log.warning("%s: material %r has a texture and Kd 0 0 0, which is read as white", path, name)
        return np.ones(3)
    return np.array(material.colour)


def _material(
    name: str | None,
    materials: dict[str, Material],
    libraries: Sequence[Path],
    path: Path,
    faces: int,
    coloured: bool,
) -> Material:
    """Return the material with this name; for faces without one, the only one (logged) or a plain one."""
    if name in materials:
        return materials[name]
    if coloured:
        return Material()
    if name is None or name.lower() in _NO_MATERIAL:
        if name is None and len(materials) == 1:
            only = next(iter(materials))
            _log.warning("%s: no usemtl before %d faces; they get the only material, %r", path, faces, only)
            return materials[only]
        return Material()
    if not libraries:
        raise ValueError(
            f"usemtl {name!r} wants a material library, but none was found; put it next to the file, or remove usemtl"
        )
    known = ", ".join(repr(other) for other in materials) or "none"
    files = ", ".join(library.name for library in libraries)
    raise ValueError(f"usemtl {name!r} is in no material library; materials in {files}: {known}")


# --- materials ---


def _libraries(text: str, path: Path) -> list[Path]:
    """Find the material libraries to which a file refers; a missing one matters only if a face needs it."""
    found = []
    for written in re.findall(r"^[ \t]*mtllib[ \t]+(.+?)[ \t]*$", text, re.MULTILINE):
        whole = find_named(written, path.parent)
        if whole is not None:
            found.append(whole)
            continue
        several = [find_named(name, path.parent) for name in written.split()]
        if None in several:
            _log.warning("%s: mtllib %s does not exist", path, written)
        found += [library for library in several if library is not None]
    return list(dict.fromkeys(found))


def _materials(libraries: Sequence[Path]) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    for library in libraries:
        current: Material | None = None
        for number, line in enumerate(_text(library).splitlines(), 1):
            key, rest = _halves(line)
            if key == "newmtl":
                current = materials.setdefault(rest, Material())
            elif current is not None and key == "kd":
                current.colour = _kd(rest, f"{library}, line {number}")
            elif current is not None and key == "map_kd" and rest:
                _map(current, rest, library, f"{library}, line {number}")
    return materials


def _kd(rest: str, where: str) -> tuple[float, float, float]:
    words = rest.split("#")[0].split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) == 1:
        values = values * 3
    if len(values) < 3 or not np.isfinite(values[:3]).all():
        raise ValueError(f"{where}: want Kd with three numbers, got {rest!r}")
    red, green, blue = np.clip(values[:3], 0.0, 1.0).tolist()
    return red, green, blue


def _map(material: Material, rest: str, library: Path, where: str) -> None:
    """Read a ``map_Kd``: its options, if any, and the texture's file name, which may contain spaces."""
    found = find_named(rest, library.parent) if not rest.startswith("-") else None
    if found is None:
        words = rest.split()
        while words and words[0].startswith("-"):
            option = words.pop(0).lower()
            if option in ("-o", "-s", "-t"):
                values = _leading_numbers(words)
                pair = (values[0], values[1] if len(values) > 1 else values[0] if option == "-s" else 0.0)
                if option == "-s":
                    material.scale = pair
                elif option == "-o":
                    material.offset = pair
            elif option == "-clamp":
                material.wrap = "clamp" if words.pop(0).lower() == "on" else "repeat"
            elif option in _FLAGS:
                del words[: _FLAGS[option]]
            else:
                raise ValueError(f"{where}: map_Kd has an unknown option {option}")
        written = " ".join(words)
        found = find_named(written, library.parent)
        if found is None:
            raise ValueError(
                f"{where}: the texture {written!r} was not found; put it next to {library.name} or "
                "remove map_Kd"
            )
    material.texture = found


def _leading_numbers(words: list[str]) -> list[float]:
    """Remove up to three numbers from the front, and return them; [1.0] if there are none."""
    values: list[float] = []
    while len(words) > 1 and len(values) < 3:  # the last word is the file's name
        try:
            values.append(float(words[0]))
        except ValueError:
            break
        words.pop(0)
    return values or [1.0]


# --- geometry ---


def _text(path: Path) -> str:
    """Read a text with any line endings, as UTF-8 or else as Latin-1, which older writers used."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")


def _halves(line: str) -> tuple[str, str]:
    words = line.split(None, 1)
    return (words[0].lower(), words[1].strip() if len(words) > 1 else "") if words else ("", "")


def _parse(text: str, path: Path) -> _Model:
    model, material = _Model(), None
    polygons: list[list[Corner]] = []
    for number, line in enumerate(text.split("\n"), 1):
        key, rest = _halves(line)
        if key == "v":
            model.vertices.append(rest.split("#")[0].split())
        elif key == "vt":
            model.coordinates.append(rest.split("#")[0].split())
        elif key == "vn":
            model.normals.append(rest.split("#")[0].split())
        elif key == "usemtl":
            material = rest or None
            polygons = model.faces.get(material, [])
        elif key in ("f", "fo"):
            corners = list(_corners(rest.split("#")[0].split(), model, f"line {number}"))
            if len(corners) < 3:
                raise ValueError(f"line {number}: want a face of three corners or more, got {rest!r}")
            if not polygons:
                polygons = model.faces.setdefault(material, polygons)
            polygons.append(corners)
    return model


def _corners(words: Sequence[str], model: _Model, where: str) -> Iterator[Corner]:
    counts = len(model.vertices), len(model.coordinates), len(model.normals)
    for word in words:
        made = [-1, -1, -1]
        try:
            for place, index in enumerate(word.split("/")):
                if index:
                    value = int(index)
                    # Indices count from 1; negative ones count back from the last line before the face.
                    made[place] = value - 1 if value > 0 else counts[place] + value
                    if value == 0 or made[place] < 0:
                        raise ValueError
        except (ValueError, IndexError):
            raise ValueError(f"{where}: {word!r} is not a corner of a face") from None
        if made[0] < 0:
            raise ValueError(f"{where}: {word!r} has no vertex")
        yield made[0], made[1], made[2]


def _numbers(rows: Sequence[Sequence[str]], least: int, key: str) -> Float[np.ndarray, "n m"]:
    """Return the first columns that all rows have, up to three."""
    if not rows:
        return np.zeros((0, 3))
    width = min(3, min(map(len, rows)))
    if width < least:
        raise ValueError(f"want {least} numbers in every {key}, got a line with {width}")
    try:
        return np.array([row[:width] for row in rows], dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"a {key} line has something other than numbers ({error})") from None


def _positions(model: _Model, path: Path) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"] | None]:
    """Return the vertices and their colours (``v x y z r g b``), if all have one."""
    vertices = _numbers(model.vertices, 3, "v")
    coloured = sum(len(row) >= 6 for row in model.vertices)
    if not coloured:
        return vertices, None
    if coloured < len(vertices):
        _log.warning("%s: colours left out: only %d of %d vertices have one", path, coloured, len(vertices))
        return vertices, None
    colours = _numbers([row[3:6] for row in model.vertices], 3, "v")
    if not (np.isfinite(colours).all() and (colours >= 0.0).all() and (colours <= 255.0).all()):
        raise ValueError("want vertex colours from 0 to 1, or from 0 to 255")
    return vertices, colours / 255.0 if (colours > 1.0).any() else colours


def _coordinates(rows: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n 2"]:
    """Return u and v; one number is u alone."""
    return rows[:, :2] if rows.shape[1] > 1 else np.concatenate([rows, np.zeros_like(rows)], -1)


def _triangles(polygons: list[list[Corner]], vertices: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, "f 3 3"]:
    made: list[tuple[Corner, Corner, Corner]] = []
    for polygon in polygons:
        if len(polygon) == 3:
            made.append((polygon[0], polygon[1], polygon[2]))
            continue
        at = [corner[0] for corner in polygon]
        if max(at) >= len(vertices):
            raise ValueError(f"a face refers to vertex {max(at) + 1}, but there are {len(vertices)}")
        made += [(polygon[a], polygon[b], polygon[c]) for a, b, c in clipped(vertices[at])]
    return np.array(made, dtype=np.int64)


def _uniform(corners: Int[np.ndarray, "f 3 3"]) -> Iterator[Int[np.ndarray, "some 3 3"]]:
    """Split triangles into those with and without texture coordinates; a part has normals if all its triangles do."""
    mapped = np.all(corners[:, :, 1] >= 0, axis=1)
    for chosen in (mapped, ~mapped):
        if chosen.any():
            part = corners[chosen].copy()
            if not mapped[chosen].any():
                part[:, :, 1] = -1
            if (part[:, :, 2] < 0).any():
                part[:, :, 2] = -1
            yield part


def _check_indices(corners: Int[np.ndarray, "f 3 3"], counts: tuple[int, int, int]) -> None:
    for place, (what, count) in enumerate(zip(("vertex", "vt", "vn"), counts, strict=True)):
        most = int(corners[:, :, place].max()) + 1
        if most > count:
            raise ValueError(f"a face refers to {what} {most}, but there are {count}")
