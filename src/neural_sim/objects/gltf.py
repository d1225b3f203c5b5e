"""glTF 2.0 files (.glb, .gltf): every primitive with its own material, COLOR_0 times base colour times texture."""

from __future__ import annotations

import base64
import logging
import struct
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int

from neural_sim.documents import parsed_json
from neural_sim.objects.gltf_accessors import Accessors
from neural_sim.objects.paint import Part, Texture, Wrap, encoded, find_named, read_texture, tinted

_log = logging.getLogger(__name__)

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_READ = (
    "KHR_texture_transform", "KHR_mesh_quantization", "KHR_lights_punctual", "KHR_animation_pointer",
    "EXT_texture_webp", "EXT_texture_avif",
)  # fmt: skip
"""Extensions that are accepted, in addition to all KHR_materials_*, of which only base colours are used."""
_DRACO, _GLOSSINESS = "KHR_draco_mesh_compression", "KHR_materials_pbrSpecularGlossiness"


def gltf_references(path: Path) -> list[Path]:
    """Return the files that a glTF file refers to: buffers and pictures.

    Raises:
        ValueError: the file is not glTF, or refers to a missing file.
    """
    document = _read(path)[0]
    entries = [*document.get("buffers", []), *document.get("images", [])]
    written = [entry["uri"] for entry in entries if "uri" in entry]
    return [_file_of(uri, path) for uri in written if not uri.startswith("data:")]


def read_gltf(path: Path) -> list[Part]:
    """Read the parts of a glTF file's scene, one for each primitive of each node, with +y up as in glTF.

    Raises:
        ValueError: the file is damaged or not glTF 2.0, or requires an extension that is not supported.
    """
    document, chunk = _read(path)
    version = str(document.get("asset", {}).get("version", ""))
    if version.split(".")[0] != "2":
        raise ValueError(f"want glTF 2.0, got version {version!r}")
    required = document.get("extensionsRequired", [])
    unread = [name for name in required if name not in _READ and not name.startswith("KHR_materials_")]
    if unread:
        raise ValueError(f"requires {', '.join(unread)}, which is not supported; export the file without it")
    return list(_File(path, document, chunk).parts())


def _read(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON document and the binary chunk."""
    data = path.read_bytes()
    if path.suffix.lower() == ".gltf":
        return _document(data), None
    if len(data) < 20:
        raise ValueError(f"want a .glb file, got {len(data)} bytes")
    magic, version, length = struct.unpack_from("<III", data)
    if magic != _MAGIC or version != 2:
        raise ValueError("is not a .glb file of version 2")
    if length > len(data):
        raise ValueError(f"is cut off: {len(data)} of {length} bytes")
    chunks: dict[int, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<II", data, start)
        if start + 8 + size > length:
            raise ValueError(f"is damaged: a chunk of {size} bytes goes beyond its end")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    if _JSON not in chunks:
        raise ValueError("has no JSON chunk")
    return _document(chunks[_JSON]), chunks.get(_BIN)


def _document(data: bytes) -> dict[str, Any]:
    document = parsed_json(data.decode("utf-8-sig").rstrip("\0 "))
    if not isinstance(document, dict):
        raise ValueError(f"want a JSON object, got {type(document).__name__}")
    return document


def _file_of(uri: str, path: Path) -> Path:
    found = find_named(unquote(uri), path.parent)
    if found is None:
        raise ValueError(f"refers to {unquote(uri)!r}, which does not exist")
    return found


class _File:
    """A glTF document and the files that it refers to.

    Args:
        path: the file, for messages and to find other files.
        document: its JSON.
        chunk: the binary chunk of a .glb.
    """

    def __init__(self, path: Path, document: Mapping[str, Any], chunk: bytes | None) -> None:
        self.path, self.document, self.chunk = path, document, chunk
        self._images: dict[int, Texture] = {}
        self._textures: dict[tuple[int, bytes], Texture] = {}
        self._said: set[str] = set()

    @cached_property
    def accessors(self) -> Accessors:
        """The numbers in the buffers."""
        buffers = [self._bytes(buffer) for buffer in self.document.get("buffers", [])]
        return Accessors(self.document, buffers)

    def parts(self) -> Iterator[Part]:
        """Walk the scene's nodes and yield each triangle primitive, transformed by its node."""
        for matrix, node in self._nodes():
            if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
                raise ValueError(
                    "uses EXT_mesh_gpu_instancing, which is not supported; export the file without it"
                )
            mesh = self.document["meshes"][node["mesh"]]
            if "skin" in node:
                self._say("skins are left out: meshes are drawn as modelled")
            if any("targets" in primitive for primitive in mesh["primitives"]):
                self._say("morph targets are left out")
            for primitive in mesh["primitives"]:
                part = self._part(primitive, matrix)
                if part is not None:
                    yield part

    def _say(self, what: str) -> None:
        """Warn, but only once about the same thing."""
        if what not in self._said:
            self._said.add(what)
            _log.warning("%s: %s", self.path, what)

    # --- nodes ---

    def _nodes(self) -> Iterator[tuple[Float[np.ndarray, "4 4"], Mapping[str, Any]]]:
        """Yield the nodes that have meshes, with their matrices, in the file's order."""
        nodes = self.document.get("nodes", [])
        pending = [(index, np.eye(4)) for index in reversed(self._roots(nodes))]
        seen: set[int] = set()
        while pending:
            index, parent = pending.pop()
            if index in seen:
                raise ValueError(f"nodes[{index}] has two parents, or is its own ancestor")
            seen.add(index)
            matrix = parent @ _matrix(nodes[index])
            if "mesh" in nodes[index]:
                yield matrix, nodes[index]
            pending += [(child, matrix) for child in reversed(nodes[index].get("children", []))]

    def _roots(self, nodes: list[Mapping[str, Any]]) -> list[int]:
        scenes = self.document.get("scenes", [])
        if not scenes:
            inner = {child for node in nodes for child in node.get("children", [])}
            return [index for index in range(len(nodes)) if index not in inner]
        chosen = self.document.get("scene", 0)
        if len(scenes) > 1:
            self._say(f"holds {len(scenes)} scenes; number {chosen} is used, the file's default or the first")
        return list(scenes[chosen].get("nodes", []))

    # --- geometry ---

    def _part(self, primitive: Mapping[str, Any], matrix: Float[np.ndarray, "4 4"]) -> Part | None:
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            self._say("points and lines are left out")
            return None
        read, attributes = self.accessors, primitive["attributes"]
        if _DRACO in primitive.get("extensions", {}) and not read.stored(attributes["POSITION"]):
            raise ValueError(f"is compressed by {_DRACO}, which is not supported; export the file without it")
        vertices = read.floats(attributes["POSITION"], 3)
        indices = read.integers(primitive["indices"]) if "indices" in primitive else np.arange(len(vertices))
        if len(indices) and not 0 <= indices.min() <= indices.max() < len(vertices):
            raise ValueError(f"a primitive refers to vertex {indices.max()}, but has {len(vertices)}")
        faces = _faces(indices, mode)
        if not len(faces):
            return None
        normals = read.floats(attributes["NORMAL"], 3) if "NORMAL" in attributes else None
        linear = matrix[:3, :3]
        if np.linalg.det(linear) < 0.0:
            faces = faces[:, ::-1]
        if normals is not None:
            normals = _turned(normals, linear)
        colours, uv, texture = self._look(primitive, len(vertices))
        return Part(vertices @ linear.T + matrix[:3, 3], faces, colours, normals, uv, texture)

    # --- materials ---

    def _look(
        self, primitive: Mapping[str, Any], count: int
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 2"] | None, Texture | None]:
        """Return a primitive's vertex colours in sRGB, its texture coordinates and its texture."""
        attributes = primitive["attributes"]
        material = self.document["materials"][primitive["material"]] if "material" in primitive else {}
        base, factor = _base_colour(material)
        self._check_look(material)
        paint = np.broadcast_to(np.asarray(factor[:3], dtype=np.float64), (count, 3))
        if "COLOR_0" in attributes:
            colours = self.accessors.unit(attributes["COLOR_0"])
            paint = paint * colours[:, :3]
        if base is None:
            return encoded(paint), None, None
        move = base.get("extensions", {}).get("KHR_texture_transform", {})
        name = f"TEXCOORD_{move.get('texCoord', base.get('texCoord', 0))}"
        if name not in attributes:
            self._say(f"a primitive has a texture but no {name}: it is drawn in its plain colour")
            return encoded(paint), None, None
        # Integer coordinates are fractions of their largest value, unless the file uses KHR_mesh_quantization.
        quantised = "KHR_mesh_quantization" in self.document.get("extensionsUsed", [])
        read = self.accessors
        uv = _moved(
            read.floats(attributes[name], 2) if quantised else read.unit(attributes[name])[:, :2], move
        )
        uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], -1)  # glTF counts v from the top
        if (paint == paint[:1]).all():  # multiplied into the texture, a single colour is exact
            return np.ones((count, 3)), uv, self._texture(base["index"], paint[0])
        return encoded(paint), uv, self._texture(base["index"], np.ones(3))

    def _check_look(self, material: Mapping[str, Any]) -> None:
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            self._say(f"materials with alphaMode {material['alphaMode']} are drawn opaque")
        if "emissiveTexture" in material or any(material.get("emissiveFactor", [])):
            self._say("the light that materials emit is left out")

    def _texture(self, index: int, factor: Float[np.ndarray, "3"]) -> Texture:
        """Return a texture multiplied by a linear colour."""
        key = (index, factor.tobytes())
        if key not in self._textures:
            texture = self.document["textures"][index]
            sampler = self.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
            wrap = (_WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)])
            number = self._source(texture, index)
            if number not in self._images:
                entry = self.document["images"][number]
                where = f"images[{number}] {entry.get('name') or entry.get('uri', '')[:60]}".rstrip()
                self._images[number] = read_texture(self._bytes(entry), where)
            self._textures[key] = tinted(Texture(self._images[number].pixels, wrap), factor)
        return self._textures[key]

    @staticmethod
    def _source(texture: Mapping[str, Any], index: int) -> int:
        others = texture.get("extensions", {})
        for name in ("EXT_texture_webp", "EXT_texture_avif"):
            if name in others:
                return others[name]["source"]
        if "source" not in texture:
            only = f", only that of {', '.join(others)}" if others else ""
            raise ValueError(f"textures[{index}] has no source that can be read{only}")
        return texture["source"]

    def _bytes(self, entry: Mapping[str, Any]) -> bytes:
        """Return the bytes of a buffer or picture."""
        if "bufferView" in entry:
            return self.accessors.view(entry["bufferView"])
        uri = entry.get("uri")
        if uri is None:
            if self.chunk is None and "EXT_meshopt_compression" not in entry.get("extensions", {}):
                raise ValueError("a buffer or picture has neither bytes nor a file")
            return self.chunk or b""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition("base64,")[2], validate=True)
        return _file_of(uri, self.path).read_bytes()


def _turned(normals: Float[np.ndarray, "v 3"], linear: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "v 3"]:
    """Transform normals under a linear map, by its inverse transpose."""
    if abs(np.linalg.det(linear)) < 1e-30:
        return np.full_like(normals, np.nan)  # ``repair`` recomputes them with a warning
    turned = normals @ np.linalg.inv(linear)
    return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)


def _matrix(node: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return a node's matrix: the given one, or translation times rotation times scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0.0, 0.0, 0.0, 1.0]), dtype=np.float64)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if not length > 0.0:
        raise ValueError("a node's rotation has length 0")
    x, y, z, w = x / length, y / length, z / length, w / length
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.array(node.get("scale", [1.0, 1.0, 1.0]), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def _faces(indices: Int[np.ndarray, "n"], mode: int) -> Int[np.ndarray, "f 3"]:
    """Return the triangles of a list, a strip or a fan."""
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise ValueError(f"a primitive of triangles has {len(indices)} indices, not a multiple of 3")
        return indices.reshape(-1, 3)
    if mode == _FAN:
        first = np.broadcast_to(indices[:1], (max(len(indices) - 2, 0),))
        return np.stack([indices[1:-1], indices[2:], first], -1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], -1)
    faces[1::2] = faces[1::2, [1, 0, 2]]  # every other triangle of a strip has the opposite winding
    return faces


def _base_colour(material: Mapping[str, Any]) -> tuple[Mapping[str, Any] | None, list[float]]:
    """Return the texture and the linear factor of a material's base colour."""
    older = material.get("extensions", {}).get(_GLOSSINESS)
    if older is not None:
        return older.get("diffuseTexture"), older.get("diffuseFactor", [1.0, 1.0, 1.0, 1.0])
    look = material.get("pbrMetallicRoughness", {})
    return look.get("baseColorTexture"), look.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])


def _moved(uv: Float[np.ndarray, "v 2"], move: Mapping[str, Any]) -> Float[np.ndarray, "v 2"]:
    """Apply KHR_texture_transform: offset times rotation times scale."""
    angle = move.get("rotation", 0.0)
    scaled = uv * np.asarray(move.get("scale", [1.0, 1.0]), dtype=np.float64)
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.stack(
        [cosine * scaled[:, 0] + sine * scaled[:, 1], cosine * scaled[:, 1] - sine * scaled[:, 0]], -1
    )
    return turned + np.asarray(move.get("offset", [0.0, 0.0]), dtype=np.float64)
