"""Plane, object and masks in painted scenes, whose truth is in closed form."""

import math

import numpy as np
import pytest
import torch
from painted_scenes import RESOLUTION, WHOLE, box_of, cameras, painted, pixels_of, silhouette

from neural_sim.field.scene.finding import find
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.photographs import photo_rays
from neural_sim.field.scene.plane import supporting_plane
from neural_sim.field.scene.region import SHOWS, cell_centres
from neural_sim.field.scene.rendering import object_mask
from neural_sim.field.scene.space import expand
from neural_sim.field.scene.surface import seen_surface

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
CELL = 4.0 / RESOLUTION
EDGE = (8.0 / 10.0) ** 2
"""Overlap of boxes at least eight cells wide, if each edge is off by a cell: painted surfaces are as thick."""
LOW, HIGH = (-0.25, -0.2, -0.3), (0.25, 0.3, 0.35)


def room(points, *, table=-0.3, tilt=0.0):
    """A thick table in a far round room."""
    x, _, z = points.unbind(-1)
    solid = points.norm(dim=-1) > 10.0
    if table is not None:
        below = math.cos(tilt) * z + math.sin(tilt) * x < table
        solid |= below & (points[..., :2].norm(dim=-1) < 1.5)
    return solid


def scene(points, *, others=(), **more):
    """A box in the room, and other boxes."""
    solid = room(points, **more)
    for low, high in [(LOW, HIGH), *others]:
        solid |= box_of(points, low, high)
    return solid


def found(grid, capture, box=None, up=UP):
    return find(grid, pixels_of(capture), WHOLE, capture, up, box, torch.Generator().manual_seed(0))


def second(grid, capture):
    """What is found from what was found in the same field before, and what that was."""
    first = found(grid, capture)
    generator = torch.Generator().manual_seed(0)
    return find(grid, pixels_of(capture), WHOLE, capture, UP, None, generator, first), first


def overlap(grid, capture, region, low=LOW, high=HIGH):
    """Intersection over union of each photograph's mask with the box's silhouette."""
    ious = []
    for number, photo in enumerate(capture.frames):
        ours = object_mask(grid, region, photo_rays(photo, 80), WHOLE).numpy() > 0.5
        theirs = silhouette(capture, number, low, high)
        ious.append((ours & theirs).sum() / (ours | theirs).sum())
    return np.array(ious)


@pytest.fixture(scope="module")
def capture():
    return cameras()


@pytest.fixture(scope="module")
def standing():
    return painted(scene)


def test_the_plane_and_what_stands_on_it(standing, capture):
    object_ = found(standing, capture)
    plane = object_.region.plane
    assert plane is not None
    assert plane.normal[2] > math.cos(math.radians(2.0))
    assert abs(plane.offset - LOW[2]) < CELL  # painted surfaces are a cell thick
    # The box with its neighbours of the hull, in cells.
    for ours, theirs in zip(object_.box, (LOW, HIGH), strict=True):
        assert np.abs(ours - np.array(theirs)).max() < 3.0 * CELL
    assert overlap(standing, capture, object_.region).min() > EDGE


def test_a_tilted_table(capture):
    tilt = math.radians(12.0)
    object_ = found(painted(lambda points: scene(points, tilt=tilt)), capture)
    assert object_.region.plane is not None
    along = np.array(object_.region.plane.normal) @ [math.sin(tilt), 0.0, math.cos(tilt)]
    assert along > math.cos(math.radians(2.0))


def test_what_hangs_has_no_plane_and_is_found(capture):
    """The top of the box is a plane below the cameras, on which nothing stands."""
    grid = painted(lambda points: scene(points, table=None))
    object_ = found(grid, capture)
    assert object_.region.plane is None
    assert overlap(grid, capture, object_.region).min() > EDGE


def test_the_nearest_of_several_and_what_hides_it(capture):
    """A second box, as large, behind which the first one is partly hidden in some photographs."""
    other = ((0.65, -0.3, -0.3), (0.9, 0.4, 0.5))
    grid = painted(lambda points: scene(points, others=[other]))
    object_ = found(grid, capture)
    assert object_.box[1][0] < 0.5
    for number, photo in enumerate(capture.frames):
        rays = photo_rays(photo, 80)
        ours = object_mask(grid, object_.region, rays, WHOLE).numpy()
        theirs = silhouette(capture, number, *other)
        nearer = np.linalg.norm(photo.camera_to_world[:3, 3] - [0.77, 0.0, 0.0]) < np.linalg.norm(
            photo.camera_to_world[:3, 3]
        )
        inner = theirs & silhouette(capture, number, (0.68, -0.25, -0.2), (0.87, 0.35, 0.45))
        if nearer:  # it hides what is behind it
            assert ours[inner].mean() < 0.1
        assert ours[theirs & ~silhouette(capture, number, LOW, HIGH)].mean() < 0.1


def test_a_box_says_which(capture):
    other = ((0.5, -0.3, -0.3), (1.0, 0.3, 0.3))
    grid = painted(lambda points: scene(points, others=[other]))
    object_ = found(grid, capture, box=((0.4, -0.4, -0.4), (1.1, 0.4, 0.4)))
    assert object_.region.plane is not None  # and the table in the box is not the object's
    np.testing.assert_allclose(object_.box[0], (0.4, -0.4, -0.4))
    overlaps = overlap(grid, capture, object_.region, *other)
    unhidden = [n for n, photo in enumerate(capture.frames) if photo.camera_to_world[0, 3] > 0.2]
    # It reaches beyond the unit ball, where cells are up to half as large again.
    assert len(unhidden) >= 3 and overlaps[unhidden].min() > (8.0 / 11.0) ** 2


@pytest.mark.parametrize(
    ("box", "message"),
    [
        (
            None,
            r"capture\.json: objects\.masks=scene does not find thing near \(0, 0, 0\).*set objects\.box",
        ),
        (
            ((0.4, 0.4, 0.4), (0.6, 0.6, 0.6)),
            r"objects\.box: nothing of thing is in .*0\.4.*want two corners around the object.*capture\.json",
        ),
    ],
)
def test_a_scene_without_an_object_is_refused(capture, box, message):
    grid = painted(lambda points: (points[..., 2] < -0.3) & (points[..., :2].norm(dim=-1) < 1.5))
    with pytest.raises(ValueError, match=message):
        found(grid, capture, box)


def test_a_plane_among_points_with_outliers(generator):
    """Half of the points lie on a tilted plane up to a small error, a quarter anywhere, and the rest stand on it."""
    normal = torch.tensor([0.2, -0.1, 0.97], dtype=torch.float64)
    normal = normal / normal.norm()
    plane = 1.6 * torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 0.8
    plane = plane - (plane @ normal + 0.3)[:, None] * normal
    plane = plane + 0.01 * torch.randn(2000, 1, generator=generator, dtype=torch.float64) * normal
    anywhere = 1.6 * torch.rand(1000, 3, generator=generator, dtype=torch.float64) - 0.8
    standing = 0.4 * torch.rand(800, 3, generator=generator, dtype=torch.float64) - 0.2
    eyes = 2.0 * torch.tensor([[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]], dtype=torch.float64)
    got = supporting_plane(torch.cat([plane, anywhere, standing]), UP, eyes, 0.03, generator)
    assert got is not None
    # 2,000 points of deviation 0.01 over a spread of 0.5 fix the normal to 5e-4; outliers within 0.03 of the plane, 8 %
    # as many, are uniform there.
    assert math.acos(min(1.0, float(torch.tensor(got.normal).double() @ normal))) < 0.01
    # Points below weigh four times as much: the 0.8-expectile of a normal error lies 0.55 deviations below its mean.
    assert -0.01 < got.offset + 0.3 < 0.0
    below = torch.tensor([[0.0, 0.0, -2.0], [0.5, 0.0, -2.0]], dtype=torch.float64)
    assert supporting_plane(torch.cat([plane, standing]), UP, below, 0.03, generator) is None


def test_a_blurred_surface_is_found(capture):
    """A field of few steps: no cell of the box contributes ``SHOWS``, and rays end in it all the same."""

    def blurred(points):
        return box_of(points, LOW, HIGH)

    grid = painted(lambda points: scene(points) & ~blurred(points))
    axis = torch.linspace(-2.0, 2.0, RESOLUTION + 1)
    points = expand(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3))
    grid.table[blurred(points), 0] = -0.7  # softplus(-1.4) = 0.22 an edge: half of the light in three cells
    grid.mark()
    object_ = found(grid, capture)
    surface = seen_surface(grid, pixels_of(capture), torch.arange(0, 38400, 7), WHOLE)
    off_the_table = (*LOW[:2], LOW[2] + 3.0 * CELL)
    inner = box_of(expand(cell_centres(RESOLUTION)), off_the_table, HIGH)
    assert float(surface.largest[inner].max()) < SHOWS
    for ours, theirs in zip(object_.box, (LOW, HIGH), strict=True):
        assert np.abs(ours - np.array(theirs)).max() < 4.0 * CELL


def test_a_bulge_of_the_table_between_the_arms_of_an_object_is_not_the_objects(capture):
    """An L from above; in its corner, which its hull includes, the table bulges by four cells and is less dense."""
    arms = [((-0.25, -0.2, -0.3), (0.0, 0.3, 0.35)), ((-0.25, -0.2, -0.3), (0.5, 0.0, 0.35))]
    bulge = (CELL, CELL, -0.3), (4.0 * CELL, 3.0 * CELL, -0.3 + 3.8 * CELL)
    grid = painted(lambda points: scene(points, others=arms) & ~box_of(points, (0.02, 0.02, -0.28), HIGH))
    axis = torch.linspace(-2.0, 2.0, RESOLUTION + 1)
    points = expand(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3))
    grid.table[box_of(points, *bulge), 0] = 0.1  # softplus(0.2) = 0.80 an edge, of which 55 % is absorbed
    grid.mark()
    again, first = second(grid, capture)
    centres = expand(cell_centres(RESOLUTION))
    soft = box_of(centres, (CELL, CELL, -0.3 + 1.5 * CELL), bulge[1])  # above the cells that touch the table
    hard = box_of(centres, *arms[0]) | box_of(centres, *arms[1])
    assert first.region.cells[soft].float().mean() > 0.7 and not bool(again.region.cells[soft].any())
    assert torch.equal(again.region.cells[hard], first.region.cells[hard])
    assert float(again.region.cells[hard].float().mean()) > 0.9


def test_a_low_solid_bulge_beside_an_object_is_not_the_objects(capture):
    """As dense as the object and next to it, up to a cell of the grid higher: only its height tells it apart."""
    bulge = (HIGH[0] - CELL, -0.1, -0.3), (HIGH[0] + 5.0 * CELL, 0.2, -0.3 + 1.1 * CELL)
    again, first = second(painted(lambda points: scene(points, others=[bulge])), capture)
    centres = expand(cell_centres(RESOLUTION))
    # The hull reaches a cell beyond the object.
    beside = box_of(centres, (HIGH[0] + 2.5 * CELL, -0.1, -0.3), bulge[1])
    own = box_of(centres, LOW, HIGH)
    assert bool(first.region.cells[beside].all()) and not bool(again.region.cells[beside].any())
    assert bool(again.region.cells[own].all())


def test_a_flat_object_keeps_what_is_lower_than_bulges_may_be(capture):
    """A plate with a knob: what is higher than a bulge is too little to be the whole object."""
    plate, knob = ((-0.4, -0.4, -0.3), (0.4, 0.4, -0.3 + 1.1 * CELL)), ((-0.1, -0.1, -0.3), (0.1, 0.1, 0.0))
    grid = painted(lambda points: room(points) | box_of(points, *plate) | box_of(points, *knob))
    again, _ = second(grid, capture)
    assert bool(again.region.cells[box_of(expand(cell_centres(RESOLUTION)), *plate)].all())


def test_fog_before_an_object_does_not_hide_it(standing, capture):
    """A slab in the air that takes up to three quarters of the light hides nothing: the masks are as without it."""
    object_ = found(standing, capture)
    axis = torch.linspace(-2.0, 2.0, RESOLUTION + 1)
    points = expand(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3))
    foggy = SceneGrid(RESOLUTION, standing.table.clone())
    # Softplus(-2.4) = 0.09 an edge: 1.4 along the most oblique rays, at 72 degrees, a quarter of the light.
    foggy.table[box_of(points, (-1.0, -1.0, 0.6), (1.0, 1.0, 0.9)), 0] = -1.2
    foggy.mark()
    clear, fogged = (
        torch.stack([object_mask(grid, object_.region, photo_rays(p, 80), WHOLE) for p in capture.frames])
        for grid in (standing, foggy)
    )
    assert float((clear - fogged).abs().mean()) < 0.01
    assert overlap(foggy, capture, object_.region).min() > EDGE
