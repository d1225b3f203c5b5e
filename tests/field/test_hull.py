"""The visual hull of a ball's silhouettes in closed form, of cameras off centre and of photographs that show a part."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.cameras import focal_lengths
from neural_sim.field.hull import pixels_across, visual_hull
from neural_sim.field.pool import build_pool
from neural_sim.types import PinholeCamera, PosedViews

DOUBLE = torch.float64
RADIUS = 0.45
CENTRED = PinholeCamera(64, 64, math.radians(50.0))
OFF_CENTRE = cameras.opencv_camera(72, 48, 70.0, 45.0, 20.0, 30.0)


def ball(camera, count=24, at=(0.1, -0.15, 0.2)):
    """Alpha 1 where a pixel's middle ray passes within ``RADIUS`` of the ball's middle."""
    generator = torch.Generator().manual_seed(4)
    u = torch.rand(3, count, generator=generator, dtype=DOUBLE)
    poses = cameras.orbit(math.pi * u[0], 2 * math.pi * u[1], 2.6 + u[2])
    bundle = cameras.rays(camera, poses)
    away = torch.tensor(at, dtype=DOUBLE) - bundle.origins
    along = (away * bundle.directions).sum(-1, keepdim=True)
    alpha = ((away - along * bundle.directions).norm(dim=-1) < RADIUS).double()
    images = torch.cat([0.5 * alpha[..., None].expand(-1, -1, -1, 3), alpha[..., None]], -1)
    return PosedViews(images, poses, camera), torch.tensor(at, dtype=DOUBLE)


def distances(views, middle, resolution=64):
    """Of the hull's cells, and of all cells, from the ball's middle."""
    occupied, origin, cell = visual_hull(views, resolution)
    every = torch.ones_like(occupied).nonzero()
    far = (origin + (every + 0.5) * cell - middle).norm(dim=-1).view(occupied.shape)
    return occupied, far, cell


@pytest.mark.parametrize("camera", [CENTRED, OFF_CENTRE], ids=["centred", "off centre"])
def test_the_hull_holds_the_ball_and_little_more(camera):
    views, middle = ball(camera)
    occupied, far, cell = distances(views, middle)
    assert bool(occupied[far < RADIUS].all())
    # Silhouettes grow by so many pixels a side, and half a one where a pixel begins; a quarter of the radius is for
    # directions from which no view looks (24 of them are some 40 degrees apart: 1 / cos 20 is 1.06).
    grown = math.sqrt(2.0) * (pixels_across(views, 0.5 * math.sqrt(3.0) * cell) + 0.5)
    pixel = (views.camera_to_world[:, :3, 3].norm(dim=-1).max() + 0.3 + RADIUS) / min(focal_lengths(camera))
    assert float(far[occupied].max()) < 1.25 * RADIUS + grown * float(pixel)
    assert not bool(occupied[far > 0.95].any())


def test_pixels_that_nobody_knows_carve_nothing_and_train_nothing():
    views, middle = ball(CENTRED)
    known = torch.ones(views.images.shape[:3], dtype=torch.bool)
    known[:, :, 30:] = False  # the right part of each photograph is missing
    images = views.images * known[..., None]
    cut, seen = (PosedViews(images, views.camera_to_world, CENTRED, known=k) for k in (None, known))
    kept = distances(seen, middle)
    assert bool(kept[0][kept[1] < RADIUS].all())
    lost = distances(cut, middle)
    assert not bool(lost[0][lost[1] < RADIUS].all())
    pool = build_pool(seen, None, torch.Generator().manual_seed(0))
    assert len(pool) == int(known.sum())
    assert torch.equal(seen.select(torch.tensor([2])).known, known[2:3])


def test_a_tenth_of_photographs_may_be_wrong():
    """Two of 24 cameras are said to be elsewhere: of renders that is an error, of photographs it is life."""
    views, middle = ball(CENTRED)
    poses = views.camera_to_world.clone()
    poses[[3, 11], :3, 3] += 0.8 * poses[[3, 11], :3, 0]
    known = torch.ones(views.images.shape[:3], dtype=torch.bool)
    exact, lenient = (PosedViews(views.images, poses, CENTRED, known=k) for k in (None, known))
    carved, far, _ = distances(exact, middle)
    assert not bool(carved[far < RADIUS].all())
    kept, far, _ = distances(lenient, middle)
    assert bool(kept[far < RADIUS].all())
    poses[:6, :3, 3] += 0.8 * poses[:6, :3, 0]
    kept, far, _ = distances(PosedViews(views.images, poses, CENTRED, known=known), middle)
    assert not bool(kept[far < RADIUS].all())
