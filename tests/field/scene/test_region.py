"""The object's region in closed form: its cells above the rough surface of the plane."""

import math

import pytest
import torch

from neural_sim.field.scene.plane import Plane
from neural_sim.field.scene.region import Region, cell_centres
from neural_sim.field.scene.space import contract

RESOLUTION = 16
GROUND = 0.1
TILT = math.radians(20.0)
PLANE = Plane((math.sin(TILT), 0.0, math.cos(TILT)), -0.3)


def above_the_plane(heights, away):
    """Contracted points at these heights above the plane's points that are ``away`` from the one nearest the origin."""
    normal = torch.tensor(PLANE.normal)
    along = torch.tensor([math.cos(TILT), 0.0, -math.sin(TILT)])
    return contract(away * along + (PLANE.offset + torch.tensor(heights))[:, None] * normal)


@pytest.mark.parametrize("away", [0.0, 0.7, 5.0], ids=["centre", "near", "contracted"])
def test_the_plane_carries_what_is_no_higher_than_its_roughness(away):
    """Heights are those of the scene, not of contracted space, to which the points are given."""
    region = Region(torch.ones(RESOLUTION**3, dtype=torch.bool), RESOLUTION, PLANE, GROUND)
    points = above_the_plane([-2.0, -0.01, 0.0, 0.09, 0.11, 0.2, 2.0], away)
    expected = torch.tensor([True, True, True, True, False, False, False])
    assert torch.equal(region.carries(points), expected)
    assert torch.equal(region.holds(points), ~expected)


def test_nothing_carries_an_object_without_a_plane():
    region = Region(torch.ones(RESOLUTION**3, dtype=torch.bool), RESOLUTION, None, GROUND)
    points = above_the_plane([-2.0, 0.0, 0.2], 0.0)
    assert not bool(region.carries(points).any()) and bool(region.holds(points).all())


def test_only_the_regions_own_cells_hold_the_object():
    """A cell that the plane cuts holds the object only above the plane's roughness."""
    centres = cell_centres(RESOLUTION)
    cells = torch.zeros(RESOLUTION**3, dtype=torch.bool)
    own = int((centres - torch.tensor([0.1, 0.1, -0.1])).norm(dim=-1).argmin())
    cells[own] = True
    level = Plane((0.0, 0.0, 1.0), float(centres[own, 2]) - GROUND)
    region = Region(cells, RESOLUTION, level, GROUND)
    assert bool(region.holds(centres[[own]] + torch.tensor([0.0, 0.0, 0.02])))
    assert not bool(region.holds(centres[[own]] - torch.tensor([0.0, 0.0, 0.02])))
    assert not bool(region.holds(centres[[own]] + torch.tensor([0.5, 0.0, 0.02])))
