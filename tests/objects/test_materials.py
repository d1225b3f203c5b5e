"""OBJ and PLY with several materials: what each vertex is painted with, against what the files say."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from neural_sim.objects.files import load_file, references
from neural_sim.objects.paint import find_named
from neural_sim.objects.ply import read_ply
from neural_sim.objects.polygons import clipped
from neural_sim.objects.wavefront import read_obj

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
RED, BLUE = (200, 0, 0), (0, 0, 200)


def picture(path: Path, colour: tuple[int, int, int] = RED) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), colour).save(path)
    return path


def obj(folder: Path, text: str, mtl: str | None = None) -> Path:
    path = folder / "m.obj"
    path.write_text(text)
    if mtl is not None:
        (folder / "m.mtl").write_text(mtl)
    return path


# --- OBJ ---


def test_names_with_spaces_and_several_libraries_keep_their_faces(tmp_path):
    (tmp_path / "other parts.mtl").write_text("newmtl blue paint\nKd 0 0 1\n")
    text = (
        "\ufeffmtllib m.mtl\r\nmtllib other parts.mtl\r\n" + TRIANGLE.replace("\n", "\r\n")
        + "usemtl red paint\r\nf 1/1 2/2 \\\r\n 3/3\r\nusemtl blue paint\r\nf 1/1 3/3 2/2\r\n"
    )  # fmt: skip
    path = obj(tmp_path, text, "newmtl red paint\nKd 1 0 0\n")
    red, blue = read_obj(path)
    assert red.colours[0].tolist() == [1, 0, 0] and blue.colours[0].tolist() == [0, 0, 1]
    assert [file.name for file in references(path)] == ["m.mtl", "other parts.mtl"]


def test_negative_indices_count_from_the_last_line_before_the_face(tmp_path):
    path = obj(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n")
    (part,) = read_obj(path)
    assert part.vertices[part.faces].tolist() == [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[5, 0, 0], [6, 0, 0], [5, 1, 0]],
    ]


def test_kd_multiplies_the_texture_and_options_move_it(tmp_path):
    picture(tmp_path / "a.png")
    mtl = "newmtl a\nKd 0.5 1 1\nmap_Kd -blendu off -s 2 3 1 -o 0.25 0.5 -clamp on -bm 0.3 a.png\n"
    (part,) = read_obj(obj(tmp_path, f"mtllib m.mtl\n{TRIANGLE}usemtl a\nf 1/1 2/2 3/3\n", mtl))
    assert part.texture is not None and part.texture.wrap == ("clamp", "clamp")
    assert part.texture.pixels[0, 0].tolist() == list(RED) and part.colours[0].tolist() == [0.5, 1, 1]
    np.testing.assert_allclose(part.uv[part.faces[0]], [[0.25, 0.5], [2.25, 0.5], [0.25, 3.5]])


@pytest.mark.parametrize(
    ("written", "stored"),
    [
        ("tex\\a.png", "tex/a.png"), ("C:\\me\\a.png", "a.png"), ("TEX/A.PNG", "tex/a.png"), ("a.png", "inner/a.png"),
        ("/home/me/a.png", "a.png"), ('"my a.png"', "my a.png"), ("./a.png", "a.png"), ("a.png", "../textures/a.png"),
        ("a\u0301.png", "\u00e1.png"),
    ],
)  # fmt: skip
def test_textures_are_found_however_they_are_written(tmp_path, written, stored):
    home = tmp_path / "home"
    home.mkdir()
    made = picture(home / stored)
    found = find_named(written, home)
    assert found is not None and found.samefile(made)


def test_a_name_that_several_files_have_is_refused(tmp_path):
    picture(tmp_path / "one" / "a.png")
    picture(tmp_path / "two" / "a.png")
    with pytest.raises(ValueError, match=r"'a\.png' may be any of .*one/a\.png, .*two/a\.png"):
        find_named("textures/a.png", tmp_path)


@pytest.mark.parametrize(
    ("lines", "mtl", "reason"),
    [
        ("usemtl b\nf 1 2 3", "newmtl a\nKd 1 0 0", r"usemtl 'b' is in no material library; materials in m\.mtl: 'a'"),
        ("usemtl b\nf 1 2 3", None, r"usemtl 'b' wants a material library, but none was found"),
        ("usemtl a\nf 1 2 3", "newmtl a\nmap_Kd gone.png", r"m\.mtl, line 2: the texture 'gone\.png' was not"),
        ("usemtl a\nf 1 2 3", "newmtl a\nKd red", r"m\.mtl, line 2: want Kd with three numbers, got 'red'"),
        ("usemtl a\nf 1 2 3", "newmtl a\nmap_Kd -zoom 2 a.png", r"unknown option -zoom"),
        ("f 1 2 4", None, r"refers to vertex 4, but there are 3"),
        ("f 1/9 2/1 3/1", None, r"refers to vt 9, but there are 3"),
        ("f 1 2 0", None, r"line 8: '0' is not a corner"),
        ("f 1 2", None, r"line 8: want a face of three corners"),
        ("f 1 2 -9", None, r"line 8: '-9' is not a corner"),
        ("f a b c", None, r"line 8: 'a' is not a corner"),
        ("v 1 2 x\nf 1 2 3", None, r"a v line has something other than numbers"),
        ("v 1 2\nf 1 2 3", None, r"want 3 numbers in every v"),
        ("", None, r"holds no triangles"),
    ],
)  # fmt: skip
def test_obj_refusals_name_file_and_line(tmp_path, lines, mtl, reason):
    path = obj(tmp_path, f"mtllib m.mtl\n{TRIANGLE}{lines}\n", mtl)
    with pytest.raises(ValueError, match=rf"m\.obj: .*{reason}"):
        references(path)
        load_file(path, "m", "")


def test_what_an_obj_leaves_open_is_said(tmp_path, caplog):
    picture(tmp_path / "a.png")
    text = f"mtllib gone.mtl\nmtllib m.mtl\n{TRIANGLE}usemtl a\nf 1 2 3\nusemtl None\nf 1 2 3\n"
    plain, none = read_obj(obj(tmp_path, text, "newmtl a\nKd 0 1 0\nmap_Kd a.png\n"))
    assert plain.colours[0].tolist() == [0, 1, 0] and none.colours[0] == pytest.approx(160 / 255)
    assert "mtllib gone.mtl does not exist" in caplog.text and "painted grey" in caplog.text
    assert "1 faces of material 'a' have no coordinates in its texture a.png" in caplog.text


@pytest.mark.parametrize("white", [1.0, 255.0])
def test_vertex_colours_of_an_obj(tmp_path, white):
    rows = [f"v {x} {y} 0 {white} 0 {white * z}" for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 1))]
    (part,) = read_obj(obj(tmp_path, "\n".join([*rows, "f 1 2 3"])))
    assert part.colours.tolist() == [[1, 0, 0], [1, 0, 0], [1, 0, 1]]


def test_a_polygon_with_a_notch_keeps_its_area():
    """The shoelace formula; a fan of this arrow would cover its notch."""
    arrow = np.array([[0, 0, 1], [4, 0, 1], [1, 1, 1], [0, 4, 1], [-3, -3, 1]], dtype=float)
    for turned in range(5):
        corners = np.roll(arrow, turned, axis=0)
        triangles = corners[np.array(clipped(corners))]
        areas = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2]
        x, y = arrow[:, 0], arrow[:, 1]
        assert (areas >= 0).all()
        assert areas.sum() == pytest.approx(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


# --- PLY ---


def ply(path: Path, head: list[str], rows: list[str], textures: tuple[str, ...] = ()) -> Path:
    comments = [f"comment TextureFile {name}" for name in textures]
    path.write_text("\n".join(["ply", "format ascii 1.0", *comments, *head, "end_header", *rows, ""]))
    return path


XYZ = ["element vertex 4", *(f"property float {axis}" for axis in "xyz")]
QUAD = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
FACES = ["element face 2", "property list uchar int vertex_indices"]


@pytest.mark.parametrize(("kind", "white"), [("uchar", 255), ("ushort", 65535), ("float", 1.0), ("int", 255)])
def test_ply_colours_are_fractions_of_what_their_type_holds(tmp_path, kind, white):
    head = [*XYZ, *(f"property {kind} {c}" for c in ("red", "green", "blue")), *FACES]
    rows = [*(f"{row} {white} 0 {white}" for row in QUAD), "3 0 1 2", "3 0 2 3"]
    (part,) = read_ply(ply(tmp_path / "m.ply", head, rows))
    assert (part.colours == [1, 0, 1]).all()


def test_ply_polygons_have_the_colours_of_their_faces(tmp_path):
    head = ["element vertex 5", *XYZ[1:], *FACES, *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    rows = [*QUAD, "0 0 1", "4 0 1 2 3 255 0 0", "3 0 1 4 0 0 255"]
    path = ply(tmp_path / "m.ply", head, rows)
    colours = load_file(path, "m", "").mesh.visual.face_colors[:, :3]
    assert colours.tolist() == [[255, 0, 0], [255, 0, 0], [0, 0, 255]]


def test_ply_with_several_textures_gives_each_face_its_own(tmp_path):
    for name, colour in (("a.png", RED), ("b.png", BLUE)):
        picture(tmp_path / name, colour)
    head = [*XYZ, *FACES, "property list uchar float texcoord", "property int texnumber"]
    rows = [*QUAD, "3 0 1 2 6 0 0 1 0 1 1 1", "3 0 2 3 6 0 0 1 1 0 1 0"]
    path = ply(tmp_path / "m.ply", head, rows, ("a.png", "b.png"))
    first, second = read_ply(path)
    assert [part.texture.pixels[0, 0].tolist() for part in (first, second)] == [list(RED), list(BLUE)]
    np.testing.assert_allclose(second.uv[second.faces[0]], [[0, 0], [1, 0], [1, 1]])
    assert [file.name for file in references(path)] == ["a.png", "b.png"]
    ply(path, [*head[:-1]], [row[:-2] if row.startswith("3") else row for row in rows], ("a.png", "b.png"))
    with pytest.raises(ValueError, match="no texnumber says"):
        read_ply(path)


@pytest.mark.parametrize("order", "<>")
def test_binary_ply_of_triangles_and_quads(tmp_path, order):
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = "\n".join(["ply", f"format {name} 1.0", "element vertex 5", *XYZ[1:], *FACES, "end_header\n"])
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]], dtype=f"{order}f4").tobytes()
    faces = struct.pack(f"{order}B4iB3i", 4, 0, 1, 2, 3, 3, 0, 1, 4)
    path = tmp_path / "m.ply"
    path.write_bytes(head.encode() + points + faces)
    (part,) = read_ply(path)
    assert part.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]] and part.vertices[4].tolist() == [0, 0, 1]
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="cut off"):
        read_ply(path)


def test_a_ply_that_ends_early_or_names_no_vertex_is_refused(tmp_path):
    path = ply(tmp_path / "m.ply", [*XYZ, *FACES], [*QUAD, "3 0 1 2"])
    with pytest.raises(ValueError, match=r"m\.ply: .*cut off: want 2 rows of face"):
        load_file(path, "m", "")
    ply(path, [*XYZ, *FACES], [*QUAD, "3 0 1 2", "-3 0 1 3"])
    with pytest.raises(ValueError, match="a list of face has length -3"):
        load_file(path, "m", "")
    ply(path, [*XYZ, *FACES], [*QUAD, "3 0 1 2", "3 0 1 4"])
    with pytest.raises(ValueError, match=r"refers to vertex 4 or 0, but there are 4"):
        load_file(path, "m", "")
    ply(path, [*XYZ, *FACES], [*QUAD, "3 0 1 2", "3 0 1 3"], ("gone.png",))
    with pytest.raises(ValueError, match=r"m\.ply: .*'gone\.png' was not found"):
        references(path)
