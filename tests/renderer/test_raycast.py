"""The ray caster against closed forms: a sphere's outline, Lambert's law, texture and vertex colours."""

import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from neural_sim.cameras import opencv_camera, orbit
from neural_sim.renderer.base import straight_alpha
from neural_sim.renderer.lighting import Light, Lighting, lambert
from neural_sim.renderer.raycast import Pyramid, RaycastRenderer
from neural_sim.types import PinholeCamera

LIGHT = Lighting((Light((1.0, 2.0, 2.0), 0.5),), ambient=0.4)
CAMERA = PinholeCamera(48, 40, math.radians(40.0))


def camera_at(phi, rho=0.0, distance=3.0):
    return orbit(*(torch.tensor([v], dtype=torch.float64) for v in (phi, rho, distance)))


def painted(mesh, colour):
    rgba = np.tile(np.array([*colour, 255], dtype=np.uint8), (len(mesh.vertices), 1))
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=rgba)
    return mesh


def quad(side=1.0, image=None):
    """A square in the plane z = 0 that faces +z, with image right +y and image up -x (as phi = 0 sees it)."""
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    corners = side * np.stack([1.0 - 2.0 * uv[:, 1], 2.0 * uv[:, 0] - 1.0, 0.0 * uv[:, 0]], -1)
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    if image is not None:
        material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(image))
        mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return mesh


def test_lambert_law():
    normals = np.array([[1.0, 2.0, 2.0], [-1.0, -2.0, -2.0], [2.0, -1.0, 0.0], [0.0, 0.0, 3.0]]) / 3.0
    normals[2] *= 3.0 / math.sqrt(5.0)
    white = np.array([0.9, 0.4, 0.4, 0.4 + 0.5 * 2.0 / 3.0])
    np.testing.assert_allclose(lambert(normals, LIGHT), white[:, None].repeat(3, 1))


def test_sphere_covers_the_solid_angle_of_its_cone():
    distance, radius = 3.0, 1.0
    sphere = painted(trimesh.creation.icosphere(subdivisions=4), (255, 255, 255))
    view = RaycastRenderer(4).render(sphere, CAMERA, camera_at(1.1, 0.3, distance))[0]
    focal = 0.5 * CAMERA.height / math.tan(0.5 * CAMERA.field_of_view)
    outline = focal * radius / math.sqrt(distance**2 - radius**2)
    assert view[..., 3].sum().item() == pytest.approx(math.pi * outline**2, rel=0.01)


def test_a_sphere_off_centre_lies_about_the_principal_point():
    """Its cone round the optical axis cuts the image plane in an ellipse of half-axes f_x and f_y times its slope."""
    sphere = painted(trimesh.creation.icosphere(subdivisions=5), (255, 255, 255))
    camera = opencv_camera(90, 60, 80.0, 50.0, 49.5, 24.5)
    alpha = RaycastRenderer(4).render(sphere, camera, camera_at(1.1, 0.3, 3.0))[0, ..., 3]
    slope = 1.0 / math.sqrt(3.0**2 - 1.0)
    assert alpha.sum().item() == pytest.approx(math.pi * slope**2 * 80.0 * 50.0, rel=0.005)
    columns, rows = torch.arange(90) + 0.5, torch.arange(60) + 0.5
    middle = (alpha.sum(0) * columns).sum() / alpha.sum(), (alpha.sum(1) * rows).sum() / alpha.sum()
    assert [float(m) for m in middle] == pytest.approx([50.0, 25.0], abs=0.02)
    wide, high = (float(alpha.amax(axis).sum()) for axis in (0, 1))
    assert (wide, high) == pytest.approx((2.0 * 80.0 * slope, 2.0 * 50.0 * slope), abs=0.7)


def test_colour_is_albedo_times_light_on_both_sides():
    sheet = painted(quad(2.0), (200, 100, 50))
    albedo = torch.tensor([200, 100, 50]) / 255.0
    above, below = RaycastRenderer(2, LIGHT).render(
        sheet, CAMERA, torch.cat([camera_at(0.0), camera_at(math.pi)])
    )
    facing, away = 0.4 + 0.5 * 2.0 / 3.0, 0.4
    torch.testing.assert_close(above[20, 24, :3], albedo * facing, atol=1e-5, rtol=0)
    torch.testing.assert_close(below[20, 24, :3], albedo * away, atol=1e-5, rtol=0)


def test_texture_lies_the_right_way_round():
    quarters = np.zeros((2, 2, 3), dtype=np.uint8)
    quarters[0, 0], quarters[0, 1], quarters[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    image = quarters.repeat(32, 0).repeat(32, 1)
    unlit = Lighting((), ambient=1.0)
    view = RaycastRenderer(2, unlit).render(quad(0.9, image), CAMERA, camera_at(0.0))[0]
    for row, column, colour in (
        (14, 18, (1, 0, 0)),
        (14, 30, (0, 1, 0)),
        (26, 18, (0, 0, 1)),
        (26, 30, (0, 0, 0)),
    ):
        torch.testing.assert_close(view[row, column, :3], torch.tensor(colour).float(), atol=0.01, rtol=0)


def test_fine_texture_is_averaged_not_aliased():
    stripes = np.zeros((512, 512, 3), dtype=np.uint8)
    stripes[:, ::2] = 255
    unlit = Lighting((), ambient=1.0)
    view = RaycastRenderer(1, unlit).render(quad(0.9, stripes), CAMERA, camera_at(0.0))[0]
    inner = view[14:26, 18:30, :3]
    torch.testing.assert_close(inner, torch.full_like(inner, 0.5), atol=0.01, rtol=0)


def test_pyramid_interpolates_texel_centres_and_levels():
    texture = np.zeros((4, 4, 3), dtype=np.uint8)
    texture[:, 2:] = 200
    pyramid = Pyramid(texture)
    uv = np.array([[0.375, 0.5], [0.5, 0.5], [0.625, 0.5]])
    np.testing.assert_allclose(pyramid.sample(uv, np.zeros(3))[:, 0] * 255.0, [0.0, 100.0, 200.0])
    np.testing.assert_allclose(pyramid.sample(uv, np.full(3, 9.0))[:, 0] * 255.0, 100.0)


def test_face_colours_stay_on_their_faces():
    sheet = quad(2.0)
    sheet.visual = trimesh.visual.ColorVisuals(sheet, face_colors=[[255, 0, 0, 255], [0, 0, 255, 255]])
    unlit = Lighting((), ambient=1.0)
    view = RaycastRenderer(1, unlit).render(sheet, CAMERA, camera_at(0.0))[0]
    assert view[25, 34, :3].tolist() == [1.0, 0.0, 0.0] and view[15, 14, :3].tolist() == [0.0, 0.0, 1.0]


def test_alpha_is_straight():
    # Half-covered pixels keep the object's colour; premultiplied averages would darken them.
    samples = np.zeros((2, 4, 4), dtype=np.float32)
    samples[:, 1:3] = (0.8, 0.4, 0.2, 1.0)
    result = straight_alpha(samples, 2)
    np.testing.assert_allclose(result, np.tile(np.float32([0.8, 0.4, 0.2, 0.5]), (1, 2, 1)), rtol=1e-6)
    empty = straight_alpha(np.zeros((2, 2, 4), dtype=np.float32), 2)
    assert not empty.any()


def test_a_mesh_without_faces_is_refused():
    with pytest.raises(ValueError, match="no faces"):
        RaycastRenderer().render(trimesh.Trimesh(), CAMERA, camera_at(0.0))


def test_no_cameras_no_images():
    images = RaycastRenderer().render(painted(quad(), (9, 9, 9)), CAMERA, torch.zeros(0, 4, 4))
    assert images.shape == (0, 40, 48, 4)
