"""Captures that are made and read back: poses, lenses, silhouettes, and views without distortion."""

import json
import logging
import math

import numpy as np
import pytest
import torch
from captures import DISTORTION, capture, distorted

from neural_sim.objects.capture import Lens
from neural_sim.objects.photos import Photos
from neural_sim.objects.placing import place, upright
from neural_sim.objects.resampling import turned_to_origin
from neural_sim.objects.ycb import YCB
from neural_sim.renderer.raycast import RaycastRenderer

KINDS = ("transforms", "colmap_text", "colmap_binary")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return {kind: capture(tmp_path_factory.mktemp(kind), kind=kind) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_poses_and_lenses_come_back(made, kind):
    truth = made[kind]
    frames = Photos(truth.folder.parent).captures["can"].frames
    assert len(frames) == 16
    np.testing.assert_allclose(np.stack([f.camera_to_world for f in frames]), truth.poses, atol=1e-6)
    k = truth.intrinsics
    for frame in frames:
        lens = frame.lens
        assert (lens.width, lens.height, lens.fisheye) == (200, 150, False)
        got = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial[:2], *lens.tangential)
        want = [k[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")]
        assert got == pytest.approx(want, rel=1e-6)


def test_the_lens_is_opencvs():
    lens = Lens(200, 150, 210.0, 190.0, 104.0, 71.0, (DISTORTION["k1"], DISTORTION["k2"]), (),
                (DISTORTION["p1"], DISTORTION["p2"]))  # fmt: skip
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 0.3
    points[:, 2] -= 2.0
    x, y = (points[:, 0] / -points[:, 2]).numpy(), (-points[:, 1] / -points[:, 2]).numpy()
    u, v = distorted(x, y, DISTORTION)
    pixel, seen = lens.project(points)
    assert seen.all()
    np.testing.assert_allclose(pixel.numpy(), np.stack([210.0 * u + 104.0, 190.0 * v + 71.0], -1), atol=1e-10)


def test_a_fisheye_measures_angles_and_a_divisor_divides():
    at = torch.tensor([[math.tan(0.7), 0.0, -1.0], [0.0, -math.tan(0.4), -1.0]], dtype=torch.float64)
    fisheye = Lens(100, 80, 50.0, 40.0, 50.0, 40.0, (0.03,), fisheye=True).project(at)[0]
    want = [[50.0 + 50.0 * 0.7 * (1 + 0.03 * 0.49), 40.0], [50.0, 40.0 + 40.0 * 0.4 * (1 + 0.03 * 0.16)]]
    torch.testing.assert_close(fisheye, torch.tensor(want, dtype=torch.float64), atol=1e-10, rtol=0.0)
    divided = Lens(100, 80, 50.0, 40.0, 50.0, 40.0, (0.1,), (0.2,)).project(at)[0]
    r2 = math.tan(0.7) ** 2
    assert float(divided[0, 0]) == pytest.approx(
        50.0 + 50.0 * math.tan(0.7) * (1 + 0.1 * r2) / (1 + 0.2 * r2)
    )


@pytest.mark.parametrize(
    "lens",
    [
        Lens(200, 150, 210.0, 190.0, 104.0, 71.0),
        Lens(200, 150, 210.0, 190.0, 104.0, 71.0, (-0.12, 0.05), (), (0.002, -0.003)),
        Lens(200, 150, 210.0, 190.0, 104.0, 71.0, (0.1, 0.02), (0.2, 0.01, 0.001), (0.002, -0.003)),
        Lens(200, 150, 90.0, 80.0, 104.0, 71.0, (0.03, -0.002), fisheye=True),
    ],
)
def test_directions_of_pixels_project_to_them(lens):
    x, y = torch.meshgrid(torch.linspace(0.5, 199.5, 17), torch.linspace(0.5, 149.5, 13), indexing="xy")
    pixel = torch.stack([x, y], -1).double()
    directions, seen = lens.directions(pixel)
    assert seen.all()
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(13, 17, dtype=torch.float64))
    back, visible = lens.project(3.0 * directions)
    assert visible.all()
    torch.testing.assert_close(back, pixel, atol=1e-6, rtol=0.0)


def test_pixels_that_no_direction_reaches_are_not_seen():
    """r - 0.3 r^3 is at most 2/3 of the radius at which it turns back."""
    lens = Lens(100, 80, 50.0, 50.0, 50.0, 40.0, (-0.3,))
    highest = 50.0 * 2.0 / 3.0 / math.sqrt(3 * 0.3)
    pixel = torch.tensor([[50.0 + 0.98 * highest, 40.0], [50.0 + 1.02 * highest, 40.0]], dtype=torch.float64)
    assert lens.directions(pixel)[1].tolist() == [True, False]


def test_a_lens_sees_nothing_behind_or_where_its_polynomial_turns_back():
    lens = Lens(100, 80, 50.0, 40.0, 50.0, 40.0, (-0.3,))
    turning = 1.0 / math.sqrt(3 * 0.3)  # d/dr (r - 0.3 r^3) = 0
    at = [[0.98 * turning, 0.0, -1.0], [1.02 * turning, 0.0, -1.0], [0.0, 0.0, 1.0]]
    assert lens.project(torch.tensor(at, dtype=torch.float64))[1].tolist() == [True, False, False]


def aligned(photos, truth, name="can"):
    """The placement's error: of the object's frame against the mesh's own bounds, in radii."""
    placement = photos.placement(name)
    vertices = truth.mesh.vertices @ placement.to_object[:3, :3].T + placement.to_object[:3, 3]
    return placement, vertices


@pytest.mark.parametrize("kind", KINDS)
def test_centre_and_radius_are_those_of_the_silhouettes_space(made, kind):
    """The space that silhouettes share holds the object and, of views from above alone, a little more."""
    truth = made[kind]
    placement, vertices = aligned(Photos(truth.folder.parent, up="-y"), truth)
    reach = np.linalg.norm(vertices, axis=1).max()
    assert 0.75 < reach < 1.03
    assert 1.0 / 1.03 < placement.radius / truth.radius < 1.0 / 0.75
    # The can's axis is upright: its vertices' second moments are largest along z and equal across.
    spread = np.ptp(vertices, axis=0)
    assert spread[0] == pytest.approx(spread[1], rel=0.05)


def test_up_is_estimated_and_said(made, caplog):
    truth = made["colmap_text"]
    with caplog.at_level(logging.INFO):
        estimated = Photos(truth.folder.parent).placement("can").to_object
    assert "up is assumed to be" in caplog.text and "objects.up sets another" in caplog.text
    given = Photos(truth.folder.parent, up="-y").placement("can").to_object
    up = [matrix[2, :3] / np.linalg.norm(matrix[2, :3]) for matrix in (estimated, given)]
    np.testing.assert_allclose(up[1], [0.0, -1.0, 0.0], atol=1e-9)
    assert up[0] @ up[1] > math.cos(
        math.radians(20.0)
    )  # cameras all round look down on it: the mean is nearly upright


@pytest.mark.parametrize(("masks", "suffix"), [("alpha", ".png"), ("files", ".jpg")])
def test_views_are_those_of_a_camera_without_distortion(tmp_path, masks, suffix):
    """Each view against a render of the mesh by the same pinhole camera, in the object's frame."""
    truth = capture(tmp_path, masks=masks, suffix=suffix, count=12, width=240, height=180)
    photos = Photos(tmp_path, up="-y")
    views = photos.views("can", 10, 2, 64)
    assert views.images.shape == (11, 64, 64, 4) and views.known is not None  # an eighth scores
    _, vertices = aligned(photos, truth)
    mesh = truth.mesh.copy()
    normals = np.array(mesh.vertex_normals)
    mesh.vertices = vertices
    placement = photos.placement("can")
    mesh.vertex_normals = normals @ (placement.to_object[:3, :3] * placement.radius).T
    rendered = RaycastRenderer(2).render(mesh, views.camera, views.camera_to_world)
    ours, theirs = views.images[..., 3] > 0.5, (rendered[..., 3] > 0.5) & views.known
    iou = (ours & theirs).sum((1, 2)) / (ours | theirs).sum((1, 2))
    assert float(iou.min()) > 0.97
    # The lights stand in another frame here, so the brightness of sides differs; edges and print must not.
    gradient = [
        image[..., :3].mean(-1).diff(dim=-1)[(ours & theirs)[..., 1:]] for image in (views.images, rendered)
    ]
    assert float(torch.corrcoef(torch.stack(gradient))[0, 1]) > 0.8


def test_pixels_outside_a_photograph_are_not_known(tmp_path):
    """A lens that cuts the object off: those pixels say nothing, and the hull keeps what is behind them."""
    truth = capture(tmp_path, count=12, width=120, height=60, distance=(2.2, 2.5))
    views = Photos(tmp_path, up="-y").views("can", 12, 1, 48)
    assert views.known is not None and not views.known.all()
    assert not views.images[~views.known].any()
    assert truth.folder.name == "can"


def test_a_camera_turned_to_the_origin_stays_where_it_was(generator):
    pose = np.eye(4)
    pose[:3, 3] = [0.5, -0.3, 3.0]
    turned = turned_to_origin(pose)
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turned[:3, 2], pose[:3, 3] / np.linalg.norm(pose[:3, 3]), atol=1e-12)
    assert np.array_equal(turned[:3, 3], pose[:3, 3])


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 0, -1), (0.2, 0.5, -0.7)])
def test_upright_is_a_rotation_of_up_to_z(up):
    turn = upright(np.array(up, dtype=float), "can")
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(turn @ np.array(up) / np.linalg.norm(up), [0.0, 0.0, 1.0], atol=1e-12)


def test_noise_of_poses_and_exposure_is_lived_with(tmp_path):
    truth = capture(tmp_path, count=20, pose_noise=0.01, exposure=0.2)
    _, vertices = aligned(Photos(tmp_path, up="-y"), truth)
    assert 0.7 < np.linalg.norm(vertices, axis=1).max() < 1.1


def test_a_scan_is_captured_and_read_back(tmp_path, shared_data):
    (item,) = YCB(shared_data / "ycb", ["025_mug"]).load()
    truth = capture(tmp_path, name="mug", item=item, count=12, scale=item.radius)
    photos = Photos(tmp_path, up="-y", size=0.15)
    frames = photos.captures["mug"].frames
    np.testing.assert_allclose(np.stack([f.camera_to_world for f in frames]), truth.poses, atol=1e-6)
    assert photos.radius("mug") == 0.075
    _, vertices = aligned(photos, truth, "mug")
    assert 0.75 < np.linalg.norm(vertices, axis=1).max() < 1.03


def test_frames_are_split_and_blenders_files_say_which_score(tmp_path, made):
    photos = Photos(made["transforms"].folder.parent)
    train, test = photos.split("can", 100, 16)
    assert (len(train), len(test)) == (14, 2) and not set(map(id, train)) & set(map(id, test))
    assert [len(part) for part in photos.split("can", 5, 1)] == [5, 1]
    source = json.loads((made["transforms"].folder / "transforms.json").read_text())
    home = tmp_path / "can"
    (home / "images").mkdir(parents=True)
    for part, rows in {"train": slice(0, 10), "val": slice(10, 12), "test": slice(12, 16)}.items():
        frames = [{"file_path": f["file_path"].removesuffix(".png"), "transform_matrix": f["transform_matrix"]}
                  for f in source["frames"][rows]]  # fmt: skip
        angle = 2.0 * math.atan(0.5 * 200 / source["fl_x"])
        (home / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    for path in (made["transforms"].folder / "images").iterdir():
        (home / "images" / path.name).write_bytes(path.read_bytes())
    blender = Photos(tmp_path)
    assert blender.captures["can"].up == (0.0, 0.0, 1.0)
    assert blender.captures["can"].frames[0].lens.fx == pytest.approx(source["fl_x"], rel=1e-12)
    assert [len(part) for part in blender.split("can", 100, 4)] == [10, 4]


def test_a_box_bounds_centre_and_radius(tmp_path):
    """The upper half of a can by a box about it: the hull's cells end at the box, by a cell of its grid at most."""
    truth = capture(tmp_path, count=12)
    low, high = (np.array(corner) for corner in truth.mesh.bounds)
    middle = 0.5 * (low[1] + high[1])
    box = (tuple(low - 0.1), (high[0] + 0.1, middle, high[2] + 0.1))
    pictures = Photos(tmp_path, up="-y").pictures("can")
    whole, half = place(pictures, (0.0, -1.0, 0.0)), place(pictures, (0.0, -1.0, 0.0), box)
    cell = 2.0 * 1.1 * whole.radius / 48
    assert half.radius < whole.radius - cell
    bottom = np.linalg.inv(half.to_object) @ [0.0, 0.0, 0.0, 1.0]
    expected = 0.5 * (low[1] + middle)
    assert abs(bottom[1] - expected) < 2.0 * cell


@pytest.mark.slow
def test_directions_are_those_of_the_views(tmp_path):
    """Without a mask, from where the cameras look: within a few degrees of the cameras of the placed views."""
    capture(tmp_path, count=12)
    photos = Photos(tmp_path, up="-y")
    train, test = photos.split("can", 12, 1)
    placed = np.stack([photos.placement("can").pose(f.camera_to_world)[:3, 3] for f in (*train, *test)])
    order = [photos.captures["can"].frames.index(f) for f in (*train, *test)]
    cosines = (placed / np.linalg.norm(placed, axis=1, keepdims=True) * photos.directions("can")[order]).sum(
        1
    )
    assert np.degrees(np.arccos(cosines.min())) < 6.0
