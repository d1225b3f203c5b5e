"""Normalisation and its way back; repair of broken meshes."""

import logging

import numpy as np
import pytest
import trimesh

from neural_sim.objects import repair as repair_module
from neural_sim.objects.mesh import content_digest, normalise
from neural_sim.objects.repair import repair


def test_transform_leads_back_to_the_source():
    source = trimesh.creation.box((0.1, 0.2, 0.4)).apply_translation((3.0, -2.0, 0.5))
    item = normalise(source, "box", "test")
    assert np.linalg.norm(item.mesh.vertices, axis=1).max() == pytest.approx(1.0)
    restored = trimesh.transformations.transform_points(item.mesh.vertices, item.transform)
    np.testing.assert_allclose(restored, source.vertices, atol=1e-12)
    assert item.transform[0, 0] == pytest.approx(0.5 * np.sqrt(0.01 + 0.04 + 0.16))


def test_digest_follows_geometry_and_colour():
    mesh = trimesh.creation.box()
    painted = mesh.copy()
    painted.visual = trimesh.visual.ColorVisuals(painted, vertex_colors=np.full((8, 4), 9, dtype=np.uint8))
    assert content_digest(mesh) == content_digest(trimesh.creation.box())
    assert len({content_digest(m) for m in (mesh, painted, trimesh.creation.box((1, 1, 2)))}) == 3


@pytest.mark.parametrize("vertices", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.zeros((0, 3))])
def test_meshes_without_extent_are_refused(vertices):
    mesh = trimesh.Trimesh(vertices, np.zeros((0, 3), dtype=int), process=False)
    with pytest.raises(ValueError, match=r"here\.obj: want"):
        normalise(mesh, "x", "here.obj")


def test_normals_that_are_not_finite_are_recomputed(caplog):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    normals = np.array(sphere.vertex_normals)
    normals[5] = np.nan
    broken = trimesh.Trimesh(sphere.vertices, sphere.faces, vertex_normals=normals, process=False)
    mended = repair(broken, "ball", "ball.obj")
    np.testing.assert_allclose(mended.vertex_normals, sphere.vertices, atol=0.05)
    assert "ball.obj" in caplog.text and "1 of 162 normals" in caplog.text


def test_faces_without_area_or_finite_corners_are_dropped(caplog):
    box = trimesh.creation.box()
    vertices = np.concatenate([box.vertices, [[np.nan, 0.0, 0.0]]])
    faces = np.concatenate([box.faces, [[0, 1, 8], [2, 2, 3]]])
    mended = repair(trimesh.Trimesh(vertices, faces, process=False), "box", "box.ply")
    assert len(mended.faces) == 12 and len(mended.vertices) == 8
    assert "dropped 2 of 14 faces" in caplog.text


@pytest.mark.parametrize(
    "faces", [np.zeros((0, 3), dtype=int), np.array([[0, 0, 1]])], ids=["no faces", "no area"]
)
def test_meshes_with_nothing_to_draw_are_refused(faces):
    with pytest.raises(ValueError, match=r"bad\.stl.*'thing'"):
        repair(trimesh.Trimesh(np.eye(3), faces, process=False), "thing", "bad.stl")


def test_meshes_without_colour_or_texture_are_painted_plain(caplog):
    plain = repair(trimesh.creation.box(), "box", "plain.stl")
    assert set(map(tuple, plain.visual.vertex_colors)) == {repair_module.GREY}
    lost = trimesh.creation.box()
    material = trimesh.visual.material.SimpleMaterial(image=None, diffuse=(10, 200, 30, 255))
    lost.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    assert set(map(tuple, repair(lost, "box", "lost.obj").visual.vertex_colors)) == {(10, 200, 30, 255)}
    assert "plain.stl" in caplog.text and "lost.obj" in caplog.text and "no texture" in caplog.text


def test_huge_meshes_are_warned_about(caplog, monkeypatch):
    monkeypatch.setattr(repair_module, "HUGE_FACES", 10)
    with caplog.at_level(logging.WARNING):
        repair(trimesh.creation.box(), "box", "huge.ply")
    assert "12 faces" in caplog.text
