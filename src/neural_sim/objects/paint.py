"""The paint of meshes: vertex colours, and any number of textures from a file's materials."""

from __future__ import annotations

import logging
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int, Shaped, UInt8
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.base import Visuals
from trimesh.visual.material import SimpleMaterial
from typing_extensions import override

from neural_sim.pictures import read_picture

_log = logging.getLogger(__name__)

GREY = (160, 160, 160, 255)
"""The colour of meshes whose file gives none."""
LARGEST_SIDE = 8192
"""Largest side in pixels; larger textures, which some OpenGL drivers refuse, are reduced."""
Wrap = Literal["repeat", "mirror", "clamp"]
"""What a texture shows beyond its edges."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture in sRGB, and how it continues beyond its edges along u and v."""

    pixels: UInt8[np.ndarray, "h w 3"]
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")


class Paint(Visuals):
    """Vertex colours times textures, for meshes with several materials.

    Args:
        albedo: sRGB colour of each vertex, in [0, 1]; multiplies the texture.
        uv: texture coordinates of each vertex; v points up in the picture.
        page: texture of each vertex, -1: none. The vertices of a face have the same one.
        textures: the textures, in the order that ``page`` numbers them, from 0.
    """

    def __init__(
        self,
        albedo: Float[np.ndarray, "v 3"],
        uv: Float[np.ndarray, "v 2"],
        page: Int[np.ndarray, "v"],
        textures: Sequence[Texture],
    ) -> None:
        self.albedo, self.uv, self.page, self.textures = albedo, uv, page, tuple(textures)

    @property
    @override
    def kind(self) -> str:
        return "paint"

    @property
    def defined(self) -> bool:
        """Always True; trimesh asks whether there are colours."""
        return True

    @override
    def update_vertices(self, mask: Shaped[np.ndarray, "kept"]) -> None:
        self.albedo, self.uv, self.page = self.albedo[mask], self.uv[mask], self.page[mask]

    @override
    def update_faces(self, mask: Shaped[np.ndarray, "kept"]) -> None:
        """Do nothing: faces have no colours of their own."""

    @override
    def concatenate(self, other: Visuals) -> Visuals:
        raise NotImplementedError("meshes are joined by neural_sim.objects.paint.join")

    @override
    def __hash__(self) -> int:
        return hash((self.albedo.tobytes(), self.uv.tobytes(), self.page.tobytes()))

    @override
    def copy(self) -> Paint:
        return Paint(self.albedo.copy(), self.uv.copy(), self.page.copy(), self.textures)


@dataclass(frozen=True, eq=False)
class Part:
    """The triangles of one material.

    Args:
        vertices: the corners of the triangles.
        faces: indices of each triangle's three vertices.
        colours: sRGB in [0, 1], of vertices or faces; they multiply the texture.
        normals: normals of the vertices; None: derived from the faces around them.
        uv: texture coordinates of the vertices; v points up in the picture.
        texture: the texture; None: only the colours.
        by_face: whether colours belong to faces.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colours: Float[np.ndarray, "c 3"]
    normals: Float[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None
    texture: Texture | None = None
    by_face: bool = False


def join(parts: Sequence[Part]) -> trimesh.Trimesh:
    """Join parts into one mesh, with trimesh's own kinds of colours if they suffice, otherwise with ``Paint``.

    Raises:
        ValueError: there are no parts.
    """
    if not parts:
        raise ValueError("holds no triangles")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    vertices = np.concatenate([part.vertices for part in parts])
    normals = None
    if any(part.normals is not None for part in parts):
        normals = np.concatenate([_normals_of(part) for part in parts])
    joined = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    if len(parts) == 1 and parts[0].by_face:
        joined.visual = ColorVisuals(joined, face_colors=_bytes(parts[0].colours))
    else:
        joined.visual = _paint_of(parts)  # pyright: ignore[reportAttributeAccessIssue]  # trimesh takes any Visuals
    return joined


def _normals_of(part: Part) -> Float[np.ndarray, "v 3"]:
    if part.normals is not None:
        return part.normals
    return np.array(trimesh.Trimesh(part.vertices, part.faces, process=False).vertex_normals)


def _paint_of(parts: Sequence[Part]) -> Visuals:
    colours = np.clip(np.concatenate([part.colours for part in parts]), 0.0, 1.0)
    if all(part.texture is None for part in parts):
        return ColorVisuals(vertex_colors=_bytes(colours))
    textures: list[Texture] = []
    pages, uv = [], []
    for part in parts:
        if part.texture is not None and part.texture not in textures:
            textures.append(part.texture)
        page = -1 if part.texture is None else textures.index(part.texture)
        pages.append(np.full(len(part.vertices), page, dtype=np.int64))
        uv.append(np.zeros((len(part.vertices), 2)) if part.uv is None else part.uv)
    where, coordinates = np.concatenate(pages), np.concatenate(uv)
    only = textures[0]
    if (where == 0).all() and (colours == 1.0).all() and only.wrap == ("repeat", "repeat"):
        return TextureVisuals(coordinates, SimpleMaterial(image=Image.fromarray(only.pixels)))
    return Paint(colours, coordinates, where, textures)


def _bytes(colours: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 4"]:
    rgba = np.full((len(colours), 4), 255, dtype=np.uint8)
    rgba[:, :3] = np.rint(255.0 * colours)
    return rgba


# --- colours ---


def encoded(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the sRGB values of linear ones (IEC 61966-2-1)."""
    low = np.clip(linear, 0.0, 1.0)
    return np.where(low <= 0.0031308, 12.92 * low, 1.055 * low ** (1.0 / 2.4) - 0.055)


def decoded(srgb: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the linear values of sRGB ones."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def tinted(texture: Texture, factor: Float[np.ndarray, "3"]) -> Texture:
    """Multiply a texture by a linear colour, in linear space."""
    if (factor == 1.0).all():
        return texture
    values = decoded(np.arange(256) / 255.0)
    tables = np.rint(255.0 * encoded(values[:, None] * factor)).astype(np.uint8)
    pixels = np.stack([tables[:, channel][texture.pixels[..., channel]] for channel in range(3)], -1)
    return Texture(pixels, texture.wrap)


# --- files that meshes name ---


def read_texture(source: Path | bytes, where: str, wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")) -> Texture:
    """Read a picture as a texture, without opacity.

    It is not turned as EXIF says, because texture coordinates refer to the stored pixels.

    Raises:
        ValueError: no picture can be read; the message begins with ``where``.
    """
    image = read_picture(BytesIO(source) if isinstance(source, bytes) else source, where, upright=False)
    image = image.convert("RGB")
    if max(image.size) > LARGEST_SIDE:
        factor = -(-max(image.size) // LARGEST_SIDE)
        _log.info("%s: %d x %d pixels, drawn at 1/%d of that size", where, *image.size, factor)
        image = image.reduce(factor)
    return Texture(np.asarray(image), wrap)


def find_named(written: str, folder: Path) -> Path | None:
    """Find a file that a mesh in ``folder`` refers to, however the machine that wrote it spelt the name.

    Backslashes count as separators. Case is ignored if no file has exactly this name. If there is no such file, the
    last part of the name is looked for in ``folder``, in its subfolders, and in a neighbouring folder ``textures``.

    Raises:
        ValueError: several files have that last part.
    """
    parts = [part for part in written.strip().strip('"').replace("\\", "/").split("/") if part != "."]
    if not parts or not parts[-1]:
        return None
    exact = folder / "/".join(parts)
    if exact.is_file():
        return exact
    if (followed := _followed(parts, folder)) is not None:
        return followed
    last = parts[-1]
    inner = sorted(path for path in folder.iterdir() if path.is_dir())
    beside = [path for path in (folder.parent / "textures", folder.parent / "Textures") if path.is_dir()]
    for places in ([folder], inner, beside[:1]):
        found = [path for place in places if (path := _followed([last], place)) is not None]
        if len(found) > 1:
            names = ", ".join(str(path) for path in found)
            raise ValueError(f"{last!r} may be any of {names}; give its folder in the file that refers to it")
        if found:
            _log.info("%s: %r is read from %s", folder, written, found[0])
            return found[0]
    return None


def _followed(parts: Sequence[str], folder: Path) -> Path | None:
    """Follow the parts of a path, ignoring case if needed; None if they lead to no file, or to several."""
    here = folder
    for part in parts:
        if part == "..":
            here = here.parent
            continue
        if not here.is_dir():
            return None
        if not (here / part).exists():
            alike = [path for path in here.iterdir() if _plain(path.name) == _plain(part)]
            if len(alike) != 1:
                return None
            here = alike[0]
        else:
            here = here / part
    return here if here.is_file() else None


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
