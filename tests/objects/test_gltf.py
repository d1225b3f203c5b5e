"""glTF with several materials: what each vertex is painted with, against what the file says."""

import base64
import json
import logging
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neural_sim.objects.files import load_file, references
from neural_sim.objects.gltf import read_gltf
from neural_sim.objects.paint import encoded

RED, BLUE = (200, 0, 0), (0, 0, 200)


def picture(path: Path, colour: tuple[int, int, int] = RED) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), colour).save(path)
    return path


CORNERS = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
UV = np.float32([[0, 0], [1, 0], [0, 1]])


class Writer:
    """Writes small .glb files by hand: trimesh's own writer shares its reader's ideas."""

    def __init__(self) -> None:
        self.blob, self.views, self.accessors = b"", [], []

    def view(self, data: bytes, **more) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **more})
        self.blob += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def add(self, values: np.ndarray, **more) -> int:
        kinds = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
        width = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        entry = {"bufferView": self.view(values.tobytes()), "componentType": kinds[values.dtype.name]}
        self.accessors.append(entry | {"count": len(values), "type": width} | more)
        return len(self.accessors) - 1

    def save(self, path: Path, primitives: list[dict], **document) -> Path:
        whole = {
            "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "bufferViews": self.views,
            "meshes": [{"primitives": primitives}], "accessors": self.accessors, **document,
        }  # fmt: skip
        whole.setdefault("buffers", [{"byteLength": len(self.blob)}])
        text = json.dumps(whole).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + len(self.blob)
        path.write_bytes(
            struct.pack("<IIIII", 0x46546C67, 2, total, len(text), 0x4E4F534A) + text
            + struct.pack("<II", len(self.blob), 0x004E4942) + self.blob
        )  # fmt: skip
        return path


def png(colour: tuple[int, int, int], folder: Path) -> bytes:
    return picture(folder / "made.png", colour).read_bytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "m.glb"


@pytest.mark.parametrize("kind", ["float32", "uint8", "uint16"])
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colours_are_linear_and_multiply_the_factor(path, kind, width):
    writer, white = Writer(), 1 if kind == "float32" else np.iinfo(kind).max
    colours = np.array([[0.5, 0.25, 1.0, 1.0]] * 3)[:, :width]
    stored = (colours * white).astype(kind)
    attributes = {"POSITION": writer.add(CORNERS), "COLOR_0": writer.add(stored)}
    factor = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1.0, 0.1, 1.0]}}
    (part,) = read_gltf(writer.save(path, [{"attributes": attributes, "material": 0}], materials=[factor]))
    wanted = encoded(stored[0, :3] / white * [0.5, 1.0, 0.1])
    np.testing.assert_allclose(part.colours, np.tile(wanted, (3, 1)), atol=1e-7)


def test_every_primitive_has_its_own_texture_coordinates_and_wrap(path):
    writer = Writer()
    images = [{"bufferView": writer.view(png(colour, path.parent))} for colour in (RED, BLUE)]
    position, uv, other = writer.add(CORNERS), writer.add(UV), writer.add((UV * 255).astype(np.uint8))
    attributes = {"POSITION": position, "TEXCOORD_0": uv, "TEXCOORD_1": other}
    move = {"KHR_texture_transform": {"offset": [0.5, 0.0], "rotation": np.pi / 2, "scale": [2.0, 1.0]}}
    looks = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": move}}},
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 1, "texCoord": 1}}},
    ]
    first, second = read_gltf(
        writer.save(
            path, [{"attributes": attributes, "material": number} for number in (0, 1)], materials=looks,
            images=images, textures=[{"source": 0}, {"source": 1, "sampler": 0}],
            samplers=[{"wrapS": 33071, "wrapT": 33648}], extensionsRequired=["KHR_texture_transform"],
        )
    )  # fmt: skip
    assert first.texture.pixels[0, 0].tolist() == list(RED) and first.texture.wrap == ("repeat", "repeat")
    assert second.texture.pixels[0, 0].tolist() == list(BLUE) and second.texture.wrap == ("clamp", "mirror")
    # u' = 0.5 + v, v' = -2 u by the extension's matrices, counted from the top
    np.testing.assert_allclose(first.uv, np.stack([0.5 + UV[:, 1], 1.0 + 2.0 * UV[:, 0]], -1), atol=1e-7)
    np.testing.assert_allclose(second.uv, np.stack([UV[:, 0], 1.0 - UV[:, 1]], -1), atol=1e-7)


def test_a_factor_multiplies_its_texture_in_linear_space(path):
    writer = Writer()
    image = {"bufferView": writer.view(png((188, 255, 0), path.parent))}  # 188 is linear 0.5029
    look = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.5, 0.5, 1.0]}
    attributes = {"POSITION": writer.add(CORNERS), "TEXCOORD_0": writer.add(UV)}
    (part,) = read_gltf(
        writer.save(
            path, [{"attributes": attributes, "material": 0}], materials=[{"pbrMetallicRoughness": look}],
            images=[image], textures=[{"source": 0}],
        )
    )  # fmt: skip
    assert part.texture.pixels[0, 0].tolist() == [137, 188, 0] and (part.colours == 1.0).all()


def test_nodes_instances_and_mirrors(path):
    writer = Writer()
    up = writer.add(np.float32([[0, 0, 1]] * 3))
    primitive = {"attributes": {"POSITION": writer.add(CORNERS), "NORMAL": up}}
    nodes = [
        {"children": [1, 2], "translation": [10, 0, 0]},
        {"mesh": 0, "scale": [2, 1, 1], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
    ]
    turned, mirrored = read_gltf(writer.save(path, [primitive], nodes=nodes))
    np.testing.assert_allclose(turned.vertices, [[10, 0, 0], [10, 2, 0], [9, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(mirrored.vertices, [[10, 0, 5], [9, 0, 5], [10, 1, 5]], atol=1e-7)
    for part in (turned, mirrored):  # faces and normals still agree
        corners = part.vertices[part.faces[0]]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert normal @ part.normals[0] > 0


def test_strips_fans_strides_and_sparse_positions(path):
    writer = Writer()
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    wide = np.zeros((4, 5), np.float32)
    wide[:, :3] = square
    strided = {"bufferView": writer.view(wide.tobytes(), byteStride=20), "componentType": 5126}
    writer.accessors.append(strided | {"count": 4, "type": "VEC3"})
    sparse = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": {
        "count": 3, "indices": {"bufferView": writer.view(np.uint16([1, 2, 3]).tobytes()), "componentType": 5123},
        "values": {"bufferView": writer.view(square[1:].tobytes())}}}  # fmt: skip
    writer.accessors.append(sparse)
    fan = writer.add(np.uint8([0, 1, 3, 2]))
    parts = read_gltf(
        writer.save(
            path, [{"attributes": {"POSITION": 0}, "mode": 5},
                   {"attributes": {"POSITION": 1}, "mode": 6, "indices": fan}]
        )
    )  # fmt: skip
    for part in parts:
        corners = part.vertices[part.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert normals.tolist() == [[0, 0, 1]] * 2


def test_quantised_positions(path):
    writer = Writer()
    position = writer.add((CORNERS * 32767).astype(np.int16), normalized=True)
    (part,) = read_gltf(
        writer.save(
            path, [{"attributes": {"POSITION": position}}], extensionsRequired=["KHR_mesh_quantization"]
        )
    )
    np.testing.assert_allclose(part.vertices, CORNERS)


def test_gltf_text_with_buffers_and_pictures_beside_it(tmp_path):
    picture(tmp_path / "my tex.png")
    buffer = base64.b64encode(CORNERS.tobytes()).decode()
    (tmp_path / "uv.bin").write_bytes(UV.tobytes())
    document = {
        "asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "images": [{"uri": "my%20tex.png"}],
        "textures": [{"source": 0}],
        "materials": [{"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "buffers": [{"uri": f"data:application/octet-stream;base64,{buffer}", "byteLength": 36},
                    {"uri": "uv.bin", "byteLength": 24}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 1, "byteLength": 24}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"}],
    }  # fmt: skip
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps(document))
    (part,) = read_gltf(path)
    assert part.texture.pixels[0, 0].tolist() == list(RED)
    assert sorted(file.name for file in references(path)) == ["my tex.png", "uv.bin"]
    (tmp_path / "uv.bin").unlink()
    with pytest.raises(ValueError, match=r"m\.gltf: .*refers to 'uv\.bin', which does not exist"):
        references(path)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "requires EXT_meshopt_compression"),
        ({"asset": {"version": "1.0"}}, "want glTF 2.0, got version '1.0'"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "its own ancestor"),
        ({"nodes": [{"mesh": 0, "rotation": [0, 0, 0, 0]}]}, "rotation has length 0"),
        ({"nodes": [{"mesh": 7}]}, "IndexError"),
        ({"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "EXT_mesh_gpu_instancing"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 999}]}, "wants bytes 0 to 999"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}]}, "count"),
        (
            {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 9, "type": "VEC3"}]},
            "an accessor wants",
        ),
        ({"meshes": []}, "IndexError"),
        ({"scenes": [{}]}, "holds no triangles"),
    ],
)
def test_gltf_refusals_name_the_file(path, more, reason):
    writer = Writer()
    writer.save(path, [{"attributes": {"POSITION": writer.add(CORNERS)}}], **more)
    with pytest.raises(ValueError, match=rf"m\.glb: .*{reason}"):
        load_file(path, "m", "")


def test_what_a_gltf_leaves_open_is_said(path, caplog):
    writer = Writer()
    attributes = {"POSITION": writer.add(CORNERS)}
    primitives = [
        {"attributes": attributes, "material": 0, "targets": [{}]}, {"attributes": attributes, "mode": 1}
    ]  # fmt: skip
    look = {"alphaMode": "MASK", "emissiveFactor": [1, 1, 1]}
    writer.save(
        path, primitives, materials=[look], scenes=[{"nodes": [0]}, {}], nodes=[{"mesh": 0, "skin": 0}]
    )
    with caplog.at_level(logging.WARNING):
        assert len(read_gltf(path)) == 1
    for said in (
        "2 scenes; number 0",
        "skins",
        "morph targets",
        "points and lines",
        "alphaMode MASK",
        "emit",
    ):
        assert said in caplog.text
