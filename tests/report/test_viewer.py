"""The viewer: what it shows is the scene's, its page is served, and its controls move the render."""

import math
import socket
import urllib.request

import numpy as np
import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.report.viewer import GREY, PER_BIN, Shots, Viewer, colour
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera

STEP = 1.2 / 16


def block(red):
    """An opaque cube of half-side 0.6 in one colour, in cells of a sixteenth."""
    field = GridField().eval()
    field.reset(torch.ones(16, 16, 16, dtype=torch.bool), torch.full((3,), -0.6), STEP)
    with torch.no_grad():
        field.table.zero_()
        field.table[..., 0] = 30.0
        field.table[..., 1] = 6.0 if red else -6.0
        field.table[..., 2:] = -6.0
    return field.requires_grad_(False)


@pytest.fixture(scope="module")
def shots():
    distribution = SceneDistribution.of([Pose(bins=4), Zoom(bins=3)])
    subjects = tuple(FieldSubject(name, block(name == "red"), NerfRenderer()) for name in ("red", "black"))
    camera = PinholeCamera(32, 32, math.radians(40.0))
    scene = Scene(subjects, camera, Synthesizer(ProceduralClutter()), distribution)
    detector = RetinaNet(2, 32, Backbone("micro"), Head(8, 1), Anchors(sizes=((14,), (28,)), reference=48))
    params = detector.init(torch.Generator().manual_seed(0))
    params["head.classification_head.cls_logits.bias"] += 6.0  # else no score is large
    psi = torch.zeros(2, distribution.size)
    first = psi.clone()
    first[:, 1] = 2.0
    return Shots(scene, {"initial": first, "target": psi}, detector, params)


@pytest.fixture
def viewer(shots):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = Viewer(shots, port, "initial")
    yield made
    made.server.stop()


def test_points_lie_on_the_surface_in_its_colour(shots):
    points, colours = shots.cloud(0, views=8, size=48)
    assert len(points) > 1000
    to_surface = np.abs(np.abs(points).max(1) - 0.6)
    # A sample stands for half a step to each side; the density's logarithm is 30, so nothing shines through.
    assert to_surface.max() <= 0.5 * STEP * 1.02
    for axis in range(3):  # all six sides
        assert {np.sign(points[i, axis]) for i in np.flatnonzero(np.abs(points[:, axis]) > 0.5)} == {
            -1.0,
            1.0,
        }
    assert colours[:, 0].min() > 0.9 and colours[:, 1:].max() < 0.1


def test_pictures_show_the_object_before_grey_and_boxes_from_the_threshold_on(shots):
    draw = shots.draw(90.0, 0.0, 4.0)
    bare = shots.picture(0, draw, above=1.01)
    assert bare.shape == (288, 288, 3) and bare.dtype == np.uint8
    assert bare[0, 0].tolist() == [round(255 * GREY)] * 3 and bare[144, 144, 0] > 220 > 60 > bare[144, 144, 1]
    boxed = shots.picture(0, draw, above=0.05)
    assert not np.array_equal(boxed, bare)


def test_cameras_are_those_of_the_bins_and_look_at_the_object(shots):
    cameras = shots.bin_cameras(0, "initial", "pose")
    assert [each.bin for each in cameras] == [b for b in range(4) for _ in range(PER_BIN)]
    p = shots.scene.distribution.probabilities(shots.psi["initial"][0])["pose"]
    for each in cameras:
        assert each.p == pytest.approx(float(p[each.bin]))
        assert math.floor(4 * (float(each.draw.phi) / (2 * math.pi) % 1.0)) == each.bin
        position, forward = each.camera_to_world[:3, 3], -each.camera_to_world[:3, 2]
        np.testing.assert_allclose(forward, -position / np.linalg.norm(position), atol=1e-6)
    assert colour(0.0, 0.5) == (205, 205, 205) and colour(0.5, 0.5) == (0, 90, 178)


def test_the_page_is_served_to_this_machine_alone(viewer):
    with urllib.request.urlopen(viewer.address, timeout=20) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
    assert viewer.server.get_host() == "127.0.0.1"


def test_controls_change_what_is_shown(viewer):
    viewer.above.value = 1.0  # no boxes over the object
    viewer.show_picture()
    before = np.array(viewer.image.image)
    viewer.distance.value = viewer.distance.value + 0.5
    viewer.show_picture()
    assert not np.array_equal(viewer.image.image, before)
    viewer.object.value = "black"
    viewer.show_object()
    assert viewer.label == 1 and viewer.image.image[144, 144].max() < 60
    assert len(viewer.frustums) == 4 * PER_BIN
    viewer.factor.value = "zoom"
    viewer.show_object()
    assert len(viewer.frustums) == 3 * PER_BIN and "| 3 |" in viewer.bins.content
    wanted = viewer.shots.bin_cameras(1, "initial", "zoom")[-1]
    viewer.go_to(wanted)
    assert math.radians(viewer.phi.value) == pytest.approx(float(wanted.draw.phi) % (2 * math.pi), abs=1e-4)
    assert viewer.distance.value == pytest.approx(float(wanted.draw.distance), abs=1e-4)
