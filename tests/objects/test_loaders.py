"""YCB layout, BOP models and folders of meshes, on small files written here and on the real scans."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from neural_sim.objects.bop import BOP
from neural_sim.objects.folder import MeshFolder
from neural_sim.objects.ycb import YCB

# A textured triangle pair: two faces of a unit square standing in the x-z plane.
SQUARE = """mtllib textured.mtl
v 0 0 0
v 0.1 0 0
v 0.1 0 0.2
v 0 0 0.2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl material
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


@pytest.fixture
def ycb_root(tmp_path):
    for name, colour in (("001_red_thing", (255, 0, 0)), ("002_blue_thing", (0, 0, 255))):
        folder = tmp_path / "ycb" / name / "google_16k"
        folder.mkdir(parents=True)
        (folder / "textured.obj").write_text(SQUARE)
        (folder / "textured.mtl").write_text("newmtl material\nmap_Kd texture_map.png\n")
        Image.new("RGB", (8, 8), colour).save(folder / "texture_map.png")
    return tmp_path / "ycb"


def test_ycb_names_by_folder_number_or_word(ycb_root):
    assert YCB(ycb_root).names() == ["001_red_thing", "002_blue_thing"]
    for name in ("002_blue_thing", "002", "blue_thing"):
        (item,) = YCB(ycb_root, [name]).load()
        assert item.name == "002_blue_thing"
        assert item.mesh.visual.material.image.getpixel((0, 0))[:3] == (0, 0, 255)
        assert item.transform[0, 0] == pytest.approx(0.5 * np.hypot(0.1, 0.2))


def test_ycb_digest_depends_on_the_texture_and_comes_without_parsing(ycb_root):
    before = YCB(ycb_root).digests()
    Image.new("RGB", (8, 8), (0, 255, 0)).save(ycb_root / "001_red_thing" / "google_16k" / "texture_map.png")
    (ycb_root / "002_blue_thing" / "google_16k" / "textured.obj").touch()
    after = YCB(ycb_root).digests()
    assert before["001_red_thing"] != after["001_red_thing"]
    assert before["002_blue_thing"] == after["002_blue_thing"] == YCB(ycb_root).load()[1].digest


def test_ycb_refusals_say_what_there_is(ycb_root, tmp_path):
    with pytest.raises(ValueError, match=r"'003'.*001_red_thing, 002_blue_thing"):
        YCB(ycb_root, ["003"])
    with pytest.raises(ValueError, match="twice"):
        YCB(ycb_root, ["001", "red_thing"])
    for root in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(
            ValueError, match=rf"{root} holds no .*textured\.obj; get the google_16k meshes .* objects\.root"
        ):
            YCB(root)


def test_an_empty_mesh_is_refused_with_its_file(ycb_root):
    path = ycb_root / "001_red_thing" / "google_16k" / "textured.obj"
    path.write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"textured\.obj"):
        YCB(ycb_root, ["001"]).load()


def _bop(root, extents, diameter):
    root.mkdir()
    mesh = trimesh.creation.box(extents)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.full((8, 4), 200, dtype=np.uint8))
    mesh.export(root / "obj_000007.ply")
    if diameter is not None:
        (root / "models_info.json").write_text(json.dumps({"7": {"diameter": diameter}}))
    return root


def test_bop_models_are_millimetres(tmp_path):
    root = _bop(tmp_path / "models", (30.0, 40.0, 120.0), 130.0)
    for name in ("obj_000007", "000007", "7", 7):
        (item,) = BOP(root, [name]).load()
        assert item.name == "obj_000007"
        assert item.transform[0, 0] == pytest.approx(0.065)
        restored = trimesh.transformations.transform_points(item.mesh.vertices, item.transform)
        np.testing.assert_allclose(np.ptp(restored, axis=0), [0.03, 0.04, 0.12], atol=1e-7)


def test_bop_units_are_settled_by_the_diameter(tmp_path, caplog):
    (item,) = BOP(_bop(tmp_path / "metres", (0.03, 0.04, 0.12), 130.0)).load()
    assert item.transform[0, 0] == pytest.approx(0.065)
    assert "is in metres" in caplog.text
    with pytest.raises(ValueError, match=r"obj_000007\.ply.*130 mm.*says 55"):
        BOP(_bop(tmp_path / "wrong", (30.0, 40.0, 120.0), 55.0)).load()


def test_bop_without_info_is_unchecked_and_says_so(tmp_path, caplog):
    BOP(_bop(tmp_path / "models", (30.0, 40.0, 120.0), None)).load()
    assert "models_info.json is missing" in caplog.text


def test_a_bop_file_without_a_number_is_named(tmp_path):
    root = _bop(tmp_path / "models", (30.0, 40.0, 120.0), 130.0)
    (root / "obj_000007_old.ply").write_bytes((root / "obj_000007.ply").read_bytes())
    with pytest.raises(ValueError, match=r"obj_000007_old\.ply: want a number after obj_"):
        BOP(root)
    assert BOP(root, [7]).names() == ["obj_000007"]


def test_folder_takes_files_and_sub_folders(tmp_path):
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    for suffix in ("ply", "stl", "obj", "glb"):
        box.export(tmp_path / f"box_{suffix}.{suffix}")
    (tmp_path / "nested" / "deeper").mkdir(parents=True)
    box.export(tmp_path / "nested" / "deeper" / "anything.ply")
    (tmp_path / "notes.txt").write_text("not a mesh")
    loader = MeshFolder(tmp_path)
    assert loader.names() == ["box_glb", "box_obj", "box_ply", "box_stl", "nested"]
    for item in loader.load():
        # glTF has y up: its longest axis (z in the file) points along -y once upright.
        longest = 1 if item.name == "box_glb" else 2
        assert np.ptp(item.mesh.vertices, axis=0).argmax() == longest
        restored = trimesh.transformations.transform_points(item.mesh.vertices, item.transform)
        np.testing.assert_allclose(np.ptp(restored, axis=0), [0.2, 0.4, 0.6], atol=1e-6)
        assert loader.digests()[item.name] == item.digest


def test_folder_refuses_what_it_cannot_name_or_read(tmp_path):
    with pytest.raises(ValueError, match="holds no mesh"):
        MeshFolder(tmp_path)
    trimesh.creation.box().export(tmp_path / "a.ply")
    trimesh.creation.box().export(tmp_path / "a.stl")
    with pytest.raises(ValueError, match="both named 'a'"):
        MeshFolder(tmp_path)
    (tmp_path / "a.stl").unlink()
    (tmp_path / "a.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 2\n")
    with pytest.raises(ValueError, match=r"a\.ply"):
        MeshFolder(tmp_path).load()


def test_real_scans_load_with_mended_normals(shared_data, caplog):
    tuna, pitcher = YCB(shared_data / "ycb", ["007", "pitcher_base"]).load()
    assert (tuna.name, pitcher.name) == ("007_tuna_fish_can", "019_pitcher_base")
    for item in (tuna, pitcher):
        assert np.isfinite(item.mesh.vertex_normals).all()
        assert np.linalg.norm(item.mesh.vertices, axis=1).max() == pytest.approx(1.0)
        assert item.mesh.visual.material.image.size[0] >= 1024
    assert pitcher.transform[0, 0] == pytest.approx(0.136, abs=0.002)  # 24 cm tall
    assert "007_tuna_fish_can" in caplog.text


def test_meshes_of_other_formats_are_left_out_with_a_count(tmp_path, caplog):
    trimesh.creation.box().export(tmp_path / "a.ply")
    (tmp_path / "b").mkdir()
    for name in ("c.fbx", "b/d.USDZ"):
        (tmp_path / name).write_bytes(b"?")
    assert MeshFolder(tmp_path).names() == ["a"]
    assert (
        f"{tmp_path}: 2 files such as d.USDZ have a format that is not read, and are left out" in caplog.text
    )


def test_the_home_folder_is_written_short(tmp_path, ycb_root, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    trimesh.creation.box().export(tmp_path / "box.ply")
    assert MeshFolder("~", ["box"]).names() == ["box"]
    assert YCB("~/ycb").names() == ["001_red_thing", "002_blue_thing"]


def test_a_vertex_far_from_all_others_is_told(tmp_path, caplog):
    ball = trimesh.creation.icosphere(2)
    ball.export(tmp_path / "ball.ply")
    MeshFolder(tmp_path).load()
    assert "is a digit wrong" not in caplog.text
    ball.vertices[7] *= 9.0
    ball.export(tmp_path / "ball.ply")
    MeshFolder(tmp_path).load()
    assert "times as far from the middle as any other; is a digit wrong?" in caplog.text


@pytest.mark.parametrize("stray", ["4 0 0", "nan nan nan"])
def test_vertices_without_a_face_do_not_count(tmp_path, caplog, stray):
    ball = trimesh.creation.icosphere(2)
    vertices = [" ".join(map(str, row)) for row in ball.vertices]
    faces = [" ".join(map(str, [3, *row])) for row in ball.faces]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices) + 1}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header"
    )
    (tmp_path / "ball.ply").write_text("\n".join([header, *vertices, stray, *faces, ""]))
    with caplog.at_level("INFO"):
        (item,) = MeshFolder(tmp_path).load()
    assert item.radius == pytest.approx(1.0, abs=1e-6) and item.transform[:3, 3] == pytest.approx(
        0.0, abs=1e-6
    )
    assert "object 'ball': dropped 1 vertices without a face" in caplog.text
