"""Bins of symmetric and asymmetric objects."""

import math

import numpy as np
import pytest
import torch
import trimesh

from neural_sim.cameras import orbit
from neural_sim.objects.mesh import normalise
from neural_sim.objects.procedural import Procedural
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.synthesis.subjects import MeshSubject
from neural_sim.target.symmetry import equivalent_bins
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(32, 32, math.radians(40.0))
POSE = SceneDistribution.of([Pose()])
ALL_ROUND = SceneDistribution.of([Pose()], Unlearned(rho_deg=(0.0, 360.0)))  # the paper's rho
# Even light, so that only shape and texture tell sides apart.
RENDERER = RaycastRenderer(2, Lighting((), ambient=1.0))


def _grey(mesh, name):
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=[128, 128, 128, 255])
    return normalise(mesh, name, "test")


def test_a_plain_sphere_has_one_group():
    sphere = _grey(trimesh.creation.icosphere(4), "ball")
    assert equivalent_bins(
        MeshSubject(sphere.name, sphere.mesh, RENDERER), POSE, "pose", CAMERA, samples=3, tolerance=0.02
    ) == [list(range(8))]


def test_a_plain_cylinder_joins_opposite_bins():
    cylinder = _grey(trimesh.creation.cylinder(0.5, 2.0, sections=96), "rod")
    groups = equivalent_bins(
        MeshSubject(cylinder.name, cylinder.mesh, RENDERER), POSE, "pose", CAMERA, samples=3, tolerance=0.02
    )
    assert all(any({b, b + 4} <= set(group) for group in groups) for b in range(4))
    assert len(groups) > 1  # its end does not look like its side


@pytest.mark.parametrize("name", ["pitcher", "drill"])
def test_the_embedded_objects_differ_in_every_bin(name):
    (item,) = Procedural([name]).load()
    groups = equivalent_bins(MeshSubject(item.name, item.mesh, RENDERER), POSE, "pose", CAMERA, samples=3)
    assert groups == [[b] for b in range(8)]


def _mirrored(phi, rho):
    """The other pose of the same place."""
    return 2.0 * math.pi - phi, (rho + math.pi) % (2.0 * math.pi)


def test_all_round_bins_i_and_9_minus_i_are_the_same_places_with_the_camera_upside_down(generator):
    noise = ALL_ROUND.draw_noise(400, generator, torch.float64)
    draw = ALL_ROUND.hard(torch.zeros(8, dtype=torch.float64), noise)
    phi, rho = _mirrored(draw.phi, draw.rho)
    assert torch.equal(ALL_ROUND.binned[0].bin_of(phi), 7 - draw.bins[:, 0])
    here, there = orbit(draw.phi, draw.rho, draw.distance), orbit(phi, rho, draw.distance)
    upside_down = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(here @ upside_down, there, rtol=0, atol=1e-12)


def test_an_upside_down_camera_turns_the_image_so_the_bins_are_not_one():
    (item,) = Procedural(["drill"]).load()
    phi, rho, distance = torch.tensor([1.9]), torch.tensor([0.4]), torch.tensor([3.0])
    upright = RENDERER.render(item.mesh, CAMERA, orbit(phi, rho, distance))
    turned = RENDERER.render(item.mesh, CAMERA, orbit(*_mirrored(phi, rho), distance))
    # Supersampled pixels on a silhouette may fall to either side of it by rounding.
    assert (upright - turned.rot90(2, (1, 2))).abs().mean() < 1e-3 < 1e-2 < (upright - turned).abs().mean()
    assert equivalent_bins(
        MeshSubject(item.name, item.mesh, RENDERER), ALL_ROUND, "pose", CAMERA, samples=3
    ) == [[b] for b in range(8)]


def test_half_a_turn_of_the_second_angle_joins_bins_where_it_goes_all_round():
    """Only a half turn about x leaves this object as it is. It takes (phi, rho) to (phi + 180, 180 - rho), which rho in
    [-45, 45] never reaches."""
    parts = []
    for sign in (1, -1):
        part = trimesh.creation.box((0.3, 0.5, 0.7))
        part.apply_translation((0.4, 0.3 * sign, 0.5 * sign))
        part.visual = trimesh.visual.ColorVisuals(part, vertex_colors=[200, 40, 40, 255])
        parts.append(part)
    rod = trimesh.creation.box((0.9, 0.2, 0.2))
    rod.apply_translation((-0.5, 0.0, 0.0))
    rod.visual = trimesh.visual.ColorVisuals(rod, vertex_colors=[40, 40, 200, 255])
    mesh = trimesh.util.concatenate([*parts, rod])
    turned = mesh.copy()
    turned.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.allclose(
        sorted(map(tuple, mesh.vertices.round(6))), sorted(map(tuple, turned.vertices.round(6)))
    )
    item = normalise(mesh, "knot", "test")
    assert equivalent_bins(MeshSubject(item.name, item.mesh, RENDERER), POSE, "pose", CAMERA, samples=3) == [
        [b] for b in range(8)
    ]
    groups = equivalent_bins(
        MeshSubject(item.name, item.mesh, RENDERER), ALL_ROUND, "pose", CAMERA, samples=3
    )
    assert groups == [[b, b + 4] for b in range(4)]
