"""Orbit poses and rays against hand-made geometry and central differences."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.types import PinholeCamera


def _pose(phi, rho=0.0, distance=3.0):
    return cameras.orbit(*(torch.tensor(x, dtype=torch.float64) for x in (phi, rho, distance)))


@pytest.mark.parametrize("phi", [0.0, math.pi / 2, math.pi, 3 * math.pi / 2, 1.234])
@pytest.mark.parametrize("rho", [0.0, 0.7, -0.7])
def test_orbit_is_a_rotation_that_looks_at_the_origin(phi, rho):
    pose = _pose(phi, rho)
    rotation, position = pose[:3, :3], pose[:3, 3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation).item() == pytest.approx(1.0)
    assert position.norm().item() == pytest.approx(3.0)
    torch.testing.assert_close(-rotation[:, 2], -position / 3.0)


def test_quarters_of_the_circle():
    assert _pose(0.0)[:3, 3].tolist() == pytest.approx([0, 0, 3])
    assert _pose(math.pi / 2)[:3, 3].tolist() == pytest.approx([3, 0, 0], abs=1e-12)
    assert _pose(math.pi)[:3, 3].tolist() == pytest.approx([0, 0, -3], abs=1e-12)
    assert _pose(3 * math.pi / 2)[:3, 3].tolist() == pytest.approx([-3, 0, 0], abs=1e-12)


def test_the_up_vector_is_carried_through_the_pole():
    before, after = _pose(-1e-6)[:3, 1], _pose(1e-6)[:3, 1]
    assert (before @ after).item() == pytest.approx(1.0, abs=1e-10)


def test_orbit_derivative_against_central_differences():
    at = torch.tensor([0.8, 0.3, 2.7], dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda v: cameras.orbit(v[0], v[1], v[2]), at)
    for i in range(3):
        e = torch.zeros(3, dtype=torch.float64)
        e[i] = 1e-6
        slope = (cameras.orbit(*(at + e)) - cameras.orbit(*(at - e))) / 2e-6
        torch.testing.assert_close(jacobian[..., i], slope, atol=1e-8, rtol=1e-7)


def test_corner_ray_has_half_the_field_of_view():
    camera = PinholeCamera(64, 64, math.radians(40.0))
    bundle = cameras.rays(camera, _pose(math.pi / 2))
    assert bundle.directions.shape == (64, 64, 3)
    middle_top = bundle.directions[0, 31:33].mean(0)
    angle = math.atan2(middle_top[2], -middle_top[0])
    focal = cameras.focal_length(camera)
    assert angle == pytest.approx(math.atan(31.5 / focal), abs=1e-9)
    assert math.atan(32 / focal) == pytest.approx(math.radians(20.0))


def test_rays_of_single_pixels_by_hand():
    """Column 2, row 0 of the second view, at one and a half times the focal length; a rotation of the pixel's ray."""
    camera = PinholeCamera(5, 4, math.radians(50.0))
    poses = torch.stack([_pose(0.4), _pose(1.1, rho=0.2, distance=2.0)])
    found = cameras.pixel_rays(camera, poses, torch.tensor([4 * 5 + 2, 3]), torch.tensor([1.0, 1.5]))
    focal = 1.5 * 2.0 / math.tan(math.radians(25.0))
    local = torch.tensor([0.0, 1.5 / focal, -1.0], dtype=torch.float64)
    expected = poses[1, :3, :3] @ (local / local.norm())
    torch.testing.assert_close(found.directions[0], expected, atol=1e-15, rtol=0.0)
    assert torch.equal(found.origins[0], poses[1, :3, 3])
    own = cameras.rays(cameras.magnified(camera, 1.0), poses[0])
    torch.testing.assert_close(found.directions[1], own.directions[0, 3], atol=1e-15, rtol=0.0)


def test_sphere_span_hits_misses_and_starts_inside():
    camera = PinholeCamera(33, 33, math.radians(60.0))
    bundle = cameras.rays(camera, _pose(0.3))
    near, far = cameras.unit_sphere_span(bundle)
    assert near[16, 16].item() == pytest.approx(2.0) and far[16, 16].item() == pytest.approx(4.0)
    assert near[0, 0] >= far[0, 0]
    near, far = cameras.unit_sphere_span(cameras.rays(camera, _pose(0.3, distance=0.5)))
    assert (near == 0).all() and (far > 0.4).all()


MATRIX = torch.tensor([[70.0, 0.0, 20.0], [0.0, 55.0, 9.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
OFF_CENTRE = cameras.opencv_camera(48, 32, 70.0, 55.0, 20.0, 9.5)


@pytest.mark.parametrize("magnification", [1.0, 1.7])
def test_rays_project_back_onto_their_pixels(magnification):
    """OpenCV's projection, K [R | t] X, of points on the rays of an off-centre camera."""
    pose, size = _pose(0.7, rho=0.3), torch.tensor([magnification], dtype=torch.float64)
    bundle = cameras.pixel_rays(OFF_CENTRE, pose[None], torch.arange(48 * 32), size)
    points = bundle.origins + 2.5 * bundle.directions
    local = (points - pose[:3, 3]) @ pose[:3, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    matrix = MATRIX.clone()
    matrix[:2, :2] *= magnification
    pixel = local @ matrix.T
    expected = torch.stack([torch.arange(48 * 32) % 48, torch.arange(48 * 32) // 48], -1).double()
    torch.testing.assert_close(pixel[:, :2] / pixel[:, 2:], expected, atol=1e-11, rtol=0.0)


def test_a_resized_camera_sees_the_same_directions():
    """Corners of the image are corners of the image whatever the number of pixels between them."""
    small = cameras.resized(OFF_CENTRE, 24, 8)
    assert cameras.focal_lengths(small) == pytest.approx((35.0, 13.75), rel=1e-14)
    assert cameras.principal_point(small) == pytest.approx((10.25, 2.5), rel=1e-14)
    again = cameras.resized(small, 48, 32)
    assert cameras.focal_lengths(again) == pytest.approx((70.0, 55.0), rel=1e-14)


def test_distances_in_metres_are_distances_in_radii():
    number = [torch.tensor(x, dtype=torch.float64) for x in (0.4, 0.2)]
    metres, radii = (torch.tensor(x, dtype=torch.float64) for x in (0.3, 3.0))
    torch.testing.assert_close(cameras.orbit(*number, metres, radius=0.1), cameras.orbit(*number, radii))


@pytest.mark.parametrize(
    "bad",
    [(0, 8, 0.5), (8, 0, 0.5), (8, 8, 0.0), (8, 8, 3.2), (8, 8, 0.5, 0.0), (8, 8, 0.5, 1.0, (math.nan, 4.0))],
)
def test_impossible_cameras_are_refused(bad):
    with pytest.raises(ValueError, match="camera"):
        PinholeCamera(*bad)


def test_a_reframed_camera_shows_the_same_in_proportion_and_more_beside():
    camera = cameras.opencv_camera(100, 80, 120.0, 110.0, 40.0, 50.0)
    for width, height, scale in ((200, 160, 2.0), (300, 160, 2.0), (100, 400, 1.0), (50, 40, 0.5)):
        other = cameras.reframed(camera, width, height)
        assert cameras.focal_lengths(other) == pytest.approx((scale * 120.0, scale * 110.0))
        (x, y), before = cameras.principal_point(other), cameras.principal_point(camera)
        moved = (x - 0.5 * width, y - 0.5 * height)
        assert moved == pytest.approx((scale * (before[0] - 50.0), scale * (before[1] - 40.0)))
        assert (other.width, other.height) == (width, height)
    wide = cameras.reframed(PinholeCamera(10, 10, 0.7), 40, 20)
    assert wide.field_of_view == pytest.approx(0.7) and wide.centre is None


@pytest.mark.parametrize("left, top", [(0, 0), (7, 3), (-5, 12)])
def test_a_crop_casts_the_whole_images_rays(left, top):
    camera, pose = cameras.opencv_camera(20, 16, 24.0, 22.0, 8.0, 9.0), _pose(0.4, 0.3)
    part = cameras.cropped(camera, left, top, 9, 6)
    # Far pixels of a camera that is larger by as much on each side have the coordinates of those beyond the image.
    large = cameras.cropped(camera, -20, -20, 60, 60)
    wanted = cameras.rays(large, pose).directions[20 + top : 26 + top, 20 + left : 29 + left]
    torch.testing.assert_close(cameras.rays(part, pose).directions, wanted, atol=1e-12, rtol=0.0)
    whole = cameras.rays(camera, pose).directions
    torch.testing.assert_close(
        cameras.rays(large, pose).directions[20:36, 20:40], whole, atol=1e-12, rtol=0.0
    )


@pytest.mark.parametrize("shift", [(0, 0), (11, -4), (-300, 250)])
def test_a_turned_camera_sees_its_centre_shifted(shift):
    camera, pose = cameras.opencv_camera(64, 48, 60.0, 50.0, 30.0, 25.0), _pose(0.9, -0.4)
    moved = cameras.turned(camera, pose, shift)
    turn = pose[:3, :3].T @ moved[:3, :3]
    torch.testing.assert_close(turn @ turn.T, torch.eye(3, dtype=torch.float64))
    assert torch.equal(moved[:, 3], pose[:, 3]) and torch.linalg.det(turn).item() == pytest.approx(1.0)
    x, y, z = (moved[:3, :3].T @ -moved[:3, 3]).tolist()
    assert (30.0 + 60.0 * x / -z, 25.0 - 50.0 * y / -z) == pytest.approx((30 + shift[0], 25 + shift[1]))
    # The smallest such angle is that between the old and the new direction of the centre.
    angle = math.acos(min(1.0, -z / math.sqrt(x * x + y * y + z * z)))
    assert math.acos(min(1.0, (turn.trace().item() - 1.0) / 2.0)) == pytest.approx(angle, abs=1e-7)
