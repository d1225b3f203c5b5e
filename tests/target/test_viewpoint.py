"""Poses of real photographs read back as the project's own cameras."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from neural_sim.cameras import orbit
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.parameter.zoom import Zoom
from neural_sim.target.viewpoint import bins_of_poses, viewpoint_of

OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
FULL = Unlearned(rho_deg=(-180.0, 180.0))
DISTRIBUTIONS = {
    "polar": SceneDistribution.of([Pose()]),
    "polar, the paper's rho": SceneDistribution.of([Pose()], FULL),
    "azimuth": SceneDistribution.of([Pose(axis="azimuth")]),
    "both": SceneDistribution.of([Pose(axis="both")]),
    "both, other ranges": SceneDistribution.of([Pose(axis="both", other_range_deg=(60.0, 200.0))]),
    "twelve bins": SceneDistribution.of([Pose(bins=12)]),
}


def drawn(distribution, count=400):
    """Random cameras of p_psi, in float64."""
    generator = torch.Generator().manual_seed(5)
    noise = distribution.draw_noise(count, generator, torch.float64)
    return distribution.hard(distribution.psi("target", ["x"])[0], noise)


def rolled(camera_to_world, roll):
    turns = torch.from_numpy(Rotation.from_euler("z", roll.numpy()[:, None]).as_matrix())
    camera_to_world = camera_to_world.clone()
    camera_to_world[:, :3, :3] = camera_to_world[:, :3, :3] @ turns
    return camera_to_world


def object_to_camera(camera_to_world):
    """OpenGL camera-to-object as OpenCV object-to-camera."""
    return OPENCV @ torch.linalg.inv(camera_to_world)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_projects_cameras_are_read_back(name):
    """Every angle, distance and bin, of cameras that are rolled by less than a quarter turn and do not look straight at
    the object, which has its centre off its origin."""
    distribution = DISTRIBUTIONS[name]
    draw, generator = drawn(distribution), torch.Generator().manual_seed(6)
    uniform = torch.rand(len(draw), 5, generator=generator, dtype=torch.float64) - 0.5
    roll, centre = 0.98 * math.pi * uniform[:, 0], torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    cameras = rolled(orbit(draw.phi, draw.rho, draw.distance), roll)
    # Off its axis: a rotation about an axis in the image plane, by up to 0.7 radians.
    vectors = torch.cat([uniform[:, 1:3], torch.zeros(len(draw), 1)], -1).numpy()
    cameras[:, :3, :3] = cameras[:, :3, :3] @ torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    cameras[:, :3, 3] += centre
    ranges = {**distribution.ranges, **{f.coordinate: (f.low, f.high) for f in distribution.binned}}
    poses = object_to_camera(cameras)
    seen = viewpoint_of(poses, centre, ranges["phi"], ranges["rho"])
    assert _apart(seen.phi, draw.phi) < 1e-8 and _apart(seen.rho, draw.rho) < 1e-8
    assert _apart(seen.roll, roll) < 1e-8
    torch.testing.assert_close(seen.distance, draw.distance, atol=1e-12, rtol=0)
    assert torch.equal(bins_of_poses(distribution, poses, 1.0, centre), distribution.bins_of(draw)[:, 0])
    low, high = ranges["rho"]
    assert bool(((seen.rho >= low - 1e-8) & (seen.rho <= high + 1e-8)).all())


def _apart(one, other):
    """Largest difference of angles, round the circle."""
    return float((torch.remainder(one - other + math.pi, 2 * math.pi) - math.pi).abs().max())


def test_every_bin_of_every_axis_is_drawn_and_read_back():
    for name, distribution in DISTRIBUTIONS.items():
        bins = bins_of_poses(distribution, object_to_camera(orbit(*_angles(drawn(distribution)))), 1.0)
        assert len(bins.unique()) == distribution.binned[0].bins, name


def _angles(draw):
    return draw.phi, draw.rho, draw.distance


def test_a_viewpoint_rebuilds_its_camera_whatever_the_pose():
    """orbit(phi, rho, distance) Rz(roll), at any rotation, whichever ranges choose among the two names."""
    generator = torch.Generator().manual_seed(8)
    poses = torch.eye(4, dtype=torch.float64).repeat(300, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(Rotation.random(300, random_state=3).as_matrix())
    poses[:, 2, 3] = 0.4 + torch.rand(300, generator=generator, dtype=torch.float64)  # straight ahead
    for rho in ((-math.pi, math.pi), (-0.5, 0.5), (2.0, 3.0)):
        seen = viewpoint_of(poses, rho_range=rho)
        rebuilt = object_to_camera(rolled(orbit(seen.phi, seen.rho, seen.distance), seen.roll))
        torch.testing.assert_close(rebuilt, poses, atol=1e-9, rtol=0)
    full = viewpoint_of(poses)
    assert float(full.roll.abs().max()) <= 0.5 * math.pi + 1e-9  # of two names the more upright one
    within = viewpoint_of(poses, rho_range=(-0.5 * math.pi, 0.5 * math.pi))
    assert float(within.rho.abs().max()) <= 0.5 * math.pi + 1e-9  # half the circle holds one of them


def test_a_camera_above_and_one_beside_by_hand():
    """An object 2 m ahead. Seen from above: its +z points to the camera. Upright, its +x to the camera: phi is 90
    degrees."""
    above = torch.tensor(
        [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    )
    beside = torch.tensor(
        [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    )
    seen = viewpoint_of(torch.stack([above, beside]))
    torch.testing.assert_close(seen.phi, torch.tensor([0.0, 0.5 * math.pi], dtype=torch.float64))
    assert seen.distance.tolist() == [2.0, 2.0]
    assert float(seen.rho[1]) == 0.0 and float(seen.roll[1]) == 0.0


def test_distances_and_what_a_pose_does_not_tell():
    zoom = SceneDistribution.of([Zoom()])
    draw = drawn(zoom)
    poses = object_to_camera(orbit(*_angles(draw)))
    assert torch.equal(bins_of_poses(zoom, poses, 1.0), zoom.bins_of(draw)[:, 0])
    poses[:, :3, 3] *= 0.07  # metres, of an object of 7 cm
    assert torch.equal(bins_of_poses(zoom, poses, 0.07), zoom.bins_of(draw)[:, 0])
    assert bins_of_poses(zoom, poses, None).eq(-1).all()
    metres = SceneDistribution.of([Zoom(unit="metres", range=(0.5, 1.5))])
    poses[:, :3, 3] = torch.tensor([0.0, 0.0, 1.49])
    assert bins_of_poses(metres, poses, None).eq(3).all()
    focal = SceneDistribution.of([Zoom(by="focal_length", range=(0.5, 2.0))])
    assert bins_of_poses(focal, poses, 1.0).eq(-1).all()


def test_cameras_without_a_viewpoint_are_refused():
    inside, behind = torch.eye(4)[None], torch.eye(4)[None].clone()
    behind[0, 2, 3] = -1.0
    for pose in (inside, behind):
        with pytest.raises(ValueError, match="stand off the object's centre"):
            viewpoint_of(pose)
