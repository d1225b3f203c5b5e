"""Bins of symmetric and asymmetric objects."""

import math

import pytest
import trimesh

from neural_sim.objects.mesh import normalise
from neural_sim.objects.procedural import Procedural
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.target.symmetry import equivalent_bins
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(32, 32, math.radians(40.0))
POSE = SceneDistribution.of([Pose()])
# Even light, so that only shape and texture tell sides apart.
RENDERER = RaycastRenderer(2, Lighting((), ambient=1.0))


def _grey(mesh, name):
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=[128, 128, 128, 255])
    return normalise(mesh, name, "test")


def test_a_plain_sphere_has_one_group():
    sphere = _grey(trimesh.creation.icosphere(4), "ball")
    assert equivalent_bins(sphere, RENDERER, POSE, "pose", CAMERA, samples=3, tolerance=0.02) == [
        list(range(8))
    ]


def test_a_plain_cylinder_joins_opposite_bins():
    cylinder = _grey(trimesh.creation.cylinder(0.5, 2.0, sections=96), "rod")
    groups = equivalent_bins(cylinder, RENDERER, POSE, "pose", CAMERA, samples=3, tolerance=0.02)
    assert all(any({b, b + 4} <= set(group) for group in groups) for b in range(4))
    assert len(groups) > 1  # its end does not look like its side


@pytest.mark.parametrize("name", ["pitcher", "drill"])
def test_the_embedded_objects_differ_in_every_bin(name):
    (item,) = Procedural([name]).load()
    groups = equivalent_bins(item, RENDERER, POSE, "pose", CAMERA, samples=3)
    assert groups == [[b] for b in range(8)]
