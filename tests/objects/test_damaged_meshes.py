"""Damaged mesh files are refused in one line with their name, or read as a mesh that can be drawn."""

import re

import numpy as np
import pytest
import trimesh
from damage import damaged
from PIL import Image

from neural_sim.objects.files import load_file, references

COUNT = 100
"""Damaged copies of each kind; all of them take seconds."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A file of each format, with its bytes."""
    root = tmp_path_factory.mktemp("sound")
    Image.new("RGB", (4, 4), (200, 0, 0)).save(root / "a.png")
    (root / "m.mtl").write_text("newmtl a\nKd 1 0.5 1\nmap_Kd -s 2 2 1 a.png\nnewmtl b b\nKd 0 0 1\n")
    corners = trimesh.creation.icosahedron()
    lines = [
        "mtllib m.mtl",
        *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in corners.vertices),
        "vt 0 0",
        "vt 1 0",
    ]
    lines += [
        f"usemtl {'a' if n < 9 else 'b b'}\nf {a}/1 {b}/2 {c}/1"
        for n, (a, b, c) in enumerate(corners.faces + 1)
    ]
    (root / "m.obj").write_text("\n".join(lines))
    image = Image.new("RGB", (4, 4), (0, 200, 0))
    corners.visual = trimesh.visual.TextureVisuals(
        np.random.default_rng(0).random((12, 2)), trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    )
    corners.export(root / "m.glb")
    corners.visual = trimesh.visual.ColorVisuals(corners, vertex_colors=np.full((12, 4), 90, np.uint8))
    for name, encoding in (("binary", "binary"), ("text", "ascii")):
        corners.export(root / f"{name}.ply", encoding=encoding)
    corners.export(root / "m.stl")
    return {path: path.read_bytes() for path in sorted(root.iterdir()) if path.suffix != ".png"}


@pytest.mark.parametrize("name", ["m.obj", "m.mtl", "m.glb", "binary.ply", "text.ply", "m.stl"])
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_refused_by_name_or_can_be_drawn(sound, name):
    path = next(path for path in sound if path.name == name)
    mesh = path.with_name("m.obj") if name == "m.mtl" else path
    generator = np.random.default_rng(sum(name.encode()))
    refused = 0
    try:
        for _ in range(COUNT):
            path.write_bytes(damaged(sound[path], generator))
            try:
                references(mesh)
                made = load_file(mesh, "thing", "").mesh
            except ValueError as error:
                assert re.match(rf"{re.escape(str(mesh))}: ", str(error)) and "\n" not in str(error), error
                refused += 1
                continue
            assert np.isfinite(made.vertices).all() and np.isfinite(made.vertex_normals).all()
            assert len(made.faces) and made.faces.max() < len(made.vertices)
    finally:
        path.write_bytes(sound[path])
    assert refused > 0 or name == "m.mtl"
