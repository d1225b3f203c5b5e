"""Meshes from masks: a ball in closed form, its colours, and what no view sees."""

import math

import numpy as np
import pytest
import torch

from neural_sim import cameras
from neural_sim.field.reconstruction import least_alpha, reconstruct
from neural_sim.types import PinholeCamera, PosedViews

DOUBLE = torch.float64
RADIUS, MIDDLE = 0.5, torch.tensor([0.1, -0.1, 0.15], dtype=DOUBLE)
CAMERA = PinholeCamera(96, 96, math.radians(40.0))


def ball(count=60, samples=3):
    """Views of a ball whose colour is 0.5 + 0.4 n, n its outward normal, antialiased by ``samples``^2 rays a pixel."""
    generator = torch.Generator().manual_seed(4)
    u = torch.rand(3, count, generator=generator, dtype=DOUBLE)
    # Uniform over all directions of phi and rho.
    poses = cameras.orbit(2 * math.pi * u[0], 2 * math.pi * u[1], 2.8 + u[2])
    fine = cameras.resized(CAMERA, samples * CAMERA.width, samples * CAMERA.height)
    images = []
    for pose in poses:
        bundle = cameras.rays(fine, pose[None])
        origin, direction = bundle.origins[0], bundle.directions[0]
        away = origin - MIDDLE
        half = (away * direction).sum(-1)
        root = half.square() - away.square().sum(-1) + RADIUS**2
        hit = root > 0.0
        normal = (away + (-half - root.clamp_min(0.0).sqrt())[..., None] * direction) / RADIUS
        rgba = torch.cat([0.5 + 0.4 * normal, torch.ones_like(normal[..., :1])], -1) * hit[..., None]
        pooled = torch.nn.functional.avg_pool2d(rgba.movedim(-1, 0)[None], samples)[0].movedim(0, -1)
        images.append(torch.cat([pooled[..., :3] / pooled[..., 3:].clamp_min(1e-9), pooled[..., 3:]], -1))
    return PosedViews(torch.stack(images), poses, CAMERA)


@pytest.fixture(scope="module")
def views():
    return ball()


@pytest.fixture(scope="module")
def mesh(views):
    return reconstruct(views, 64)


def test_the_surface_is_the_balls(mesh):
    """Sixty views: the hull's tangent cones leave it outside the ball by 1 / cos of half the angle between neighbouring
    views (some 15 degrees, 1.035), and a cell of 1/32 radii and a pixel of 0.03 blur it; it is nowhere inside by more
    than these."""
    assert mesh.is_watertight and mesh.volume > 0.0
    far = np.linalg.norm(np.asarray(mesh.vertices) - MIDDLE.numpy(), axis=1)
    assert far.min() > RADIUS - 0.03 and far.max() < 1.15 * RADIUS
    assert np.median(far) == pytest.approx(RADIUS, abs=0.02)
    outward = (np.asarray(mesh.vertices) - MIDDLE.numpy()) / far[:, None]
    assert np.median((np.asarray(mesh.vertex_normals) * outward).sum(1)) > 0.9


def test_colours_are_those_that_the_views_show(mesh):
    outward = np.asarray(mesh.vertices) - MIDDLE.numpy()
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    off = np.abs(np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0 - (0.5 + 0.4 * outward))
    # A vertex that is 0.03 off the surface shows colours of places some 0.06 radii of the ball away.
    assert np.median(off) < 0.03 and np.quantile(off, 0.95) < 0.1


def test_the_least_alpha_is_that_of_the_mask_that_rules_a_point_out(views):
    points = torch.stack([MIDDLE, MIDDLE + torch.tensor([0.0, 0.0, 0.8], dtype=DOUBLE)])
    assert least_alpha(views, points).tolist() == pytest.approx([1.0, 0.0], abs=1e-12)


def test_unknown_pixels_carve_nothing(views):
    known = torch.zeros(views.images.shape[:3], dtype=torch.bool)
    empty = views.images.clone()
    empty[:30] = 0.0  # half of the photographs show nothing of it, and know nothing
    known[30:] = True
    kept = PosedViews(empty, views.camera_to_world, CAMERA, known=known)
    points = MIDDLE[None]
    assert float(least_alpha(kept, points)) == pytest.approx(1.0, abs=1e-12)
    assert float(least_alpha(PosedViews(empty, views.camera_to_world, CAMERA), points)) == 0.0


def test_masks_without_a_common_point_are_refused(views):
    images = views.images.clone()
    images[..., 3] *= 0.3  # above the hull's threshold, below the surface's level
    with pytest.raises(ValueError, match="no point lies within the masks of all 60 views"):
        reconstruct(PosedViews(images, views.camera_to_world, CAMERA), 32)
