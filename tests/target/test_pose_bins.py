"""Poses of real photographs read as the project's own cameras and their bins; photographs chosen by their bins."""

import json
import math

import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from neural_sim.cameras import orbit
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.parameter.zoom import Zoom
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.coco import CocoTarget
from neural_sim.target.pose_bins import apportioned, bins_of_poses, matching, most, viewpoint_of
from neural_sim.types import LabelledImages, PinholeCamera

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
        with pytest.raises(ValueError, match="want a camera away from the object's centre"):
            viewpoint_of(pose)


DOMINANT = [0.86, *[0.02] * 7]


def labelled(cells):
    """An image for each (label, bin)."""
    labels, bins = (torch.tensor([[cell[i]] for cell in cells]) for i in range(2))
    return LabelledImages(torch.zeros(len(cells), 3, 1, 1), torch.zeros(len(cells), 1, 4), labels, bins)


def test_as_many_photographs_as_the_dominant_bin_has(generator):
    """43 of the dominant bin and 1 of each other are 50; 51 want 43.86 of it, which is rounded up to 44."""
    assert apportioned(DOMINANT, 50, [43, *[9] * 7], generator) == [43, *[1] * 7]
    assert most(DOMINANT, [43, *[9] * 7], generator) == [43, *[1] * 7]
    assert most([0.5, 0.5], [3, 8], generator) in ([3, 3], [3, 4])
    assert most(DOMINANT, [0, *[9] * 7], generator) is None


def test_equal_remainders_go_to_bins_that_have_photographs(generator):
    for _ in range(10):
        assert apportioned([0.25] * 4, 2, [0, 1, 0, 1], generator) == [0, 1, 0, 1]
    found = {tuple(apportioned([0.25] * 4, 1, [1] * 4, generator) or ()) for _ in range(40)}
    assert len(found) == 4, "ties are broken at random"


@pytest.mark.parametrize("total", [1, 7, 20, 33])
def test_every_count_is_the_quota_rounded_up_or_down(total, generator):
    p = torch.rand(8, generator=generator).double()
    p /= p.sum()
    counts = apportioned(p.tolist(), total, [total] * 8, generator)
    assert counts is not None and sum(counts) == total
    assert all(abs(count - total * value) < 1 for count, value in zip(counts, p.tolist(), strict=True))


def test_each_object_follows_its_own_distribution(generator):
    cells = [(label, b) for label in (0, 1) for b in range(4) for _ in range(10)]
    goals = {
        "can": torch.tensor([1.0, 0.0, 0.0, 0.0]),
        "mug": torch.full((4,), 0.25),
        "drill": torch.ones(4) / 4,
    }
    images, rows = labelled([*cells, (-1, -1), (0, -1)]), torch.arange(5, 82)
    chosen = matching(images, rows, goals, generator, "file")
    assert len(set(chosen.tolist())) == len(chosen) and set(chosen.tolist()) <= set(rows.tolist())
    found = [tuple(cell) for cell in torch.cat([images.labels, images.bins], 1)[chosen].tolist()]
    assert sorted(found) == [(0, 0)] * 5 + [(1, b) for b in range(4) for _ in range(10)]


def test_what_cannot_be_matched_is_refused(generator):
    goals = {"can": torch.tensor([1.0, 0.0])}
    with pytest.raises(
        ValueError, match=r"file: want can in the bins with p = \[1.0, 0.0\], .* in bins \[1\]"
    ):
        matching(labelled([(0, 1)]), torch.tensor([0]), goals, generator, "file")
    with pytest.raises(ValueError, match="no photograph has a box with a pose bin"):
        matching(labelled([(0, -1)]), torch.tensor([0]), goals, generator, "file")
    two = LabelledImages(
        torch.zeros(1, 3, 1, 1), torch.zeros(1, 2, 4), torch.tensor([[0, 1]]), torch.tensor([[0, 0]])
    )
    with pytest.raises(ValueError, match=r"in one bin each, got one of can in bin 1, mug in bin 1$"):
        matching(two, torch.tensor([0]), {**goals, "mug": goals["can"]}, generator, "file")


@pytest.fixture
def target(tmp_path):
    """Twelve photographs of a can in each of eight bins, three to a scene, all different."""
    images, annotations = [], []
    for number in range(96):
        Image.new("RGB", (20, 20), (number, 255 - number, 7)).save(tmp_path / f"{number}.png")
        images.append({"id": number, "file_name": f"{number}.png", "scene": number // 3})
        box = {"image_id": number, "category_id": 1, "bbox": [2, 2, 9, 9], "pose": number % 8 + 1}
        annotations.append(box)
    document = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "can"}]}
    (tmp_path / "annotations.json").write_text(json.dumps(document))
    settings = {"bin_attribute": "pose", "split_by": "attribute:scene", "val_fraction": 0.5}
    return lambda **more: CocoTarget(tmp_path / "annotations.json", **settings | more)


def test_validation_and_test_follow_the_target_and_share_no_group(target):
    distribution = SceneDistribution.of([Pose(biased={"can": {"target": {"dominant": 3}}})])
    camera, synthesizer = PinholeCamera(20, 20, 0.7), Synthesizer(ProceduralClutter())

    def parts(**more):
        sets = target(**more).sets({"can": None}, distribution, camera, synthesizer, seed=0)
        return [(s, {round(255 * float(image[0, 10, 10])) for image in s.images}) for s in sets.values()]

    (val, val_numbers), (test, test_numbers) = parts(match_bins=True)
    (_, all_val), (_, all_test) = parts()
    assert val_numbers < all_val and test_numbers < all_test
    assert not {n // 3 for n in val_numbers} & {n // 3 for n in test_numbers}
    for part in (val, test):
        counts = torch.bincount(part.bins.flatten(), minlength=8)
        assert int(counts[2]) == int(counts.max()) and len(part) > 3
        p = torch.tensor([0.02, 0.02, 0.86, *[0.02] * 5])
        assert bool(((counts - len(part) * p).abs() < 1).all())


def test_bins_are_needed_to_match_them(target):
    with pytest.raises(ValueError, match=r"target.match_bins: want target.bin_attribute"):
        target(match_bins=True, bin_attribute=None)
