"""Corrected camera poses: each step of the method, and the whole of it on views of an object and on photographs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import capture
from made_fields import soft_ball
from scipy.spatial.transform import Rotation

from neural_sim import cameras
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.recipe import fit_field
from neural_sim.objects.photos import Photos
from neural_sim.renderer import pose_refinement
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.pose_refinement import (
    DAMPING,
    FAIR,
    PoseRefinement,
    align,
    fair_loss,
    gauss_newton_step,
    moved,
    onto,
    pose_rates,
    reduce_views,
    rotation_angle,
)  # fmt: skip
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.types import PinholeCamera, PosedViews

DOUBLE = torch.float64


def orbit(count, seed=0):
    """Cameras all about the object, at 2.6 to 3.4 radii."""
    h, turn, far = torch.rand(3, count, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))
    return cameras.orbit(torch.arccos(1 - 2 * h), 2 * math.pi * turn, 2.6 + 0.8 * far)


def disturbance(count, size, seed=1):
    return size * torch.randn(count, 6, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def errors(poses, truth):
    """Medians of the distances and of the angles in radians."""
    places = (poses[:, :3, 3] - truth[:, :3, 3]).norm(dim=-1)
    return float(places.median()), float(rotation_angle(poses[:, :3, :3], truth[:, :3, :3]).median())


@pytest.fixture
def field(generator):
    return soft_ball(generator)


def shown(field, poses, size=32):
    """Views of a field, straight alpha."""
    camera = PinholeCamera(size, size, math.radians(45.0))
    rgb, opacity = NerfRenderer().render(field, camera, poses)
    alpha = opacity[..., None]
    return PosedViews(torch.cat([rgb / alpha.clamp_min(1e-9), alpha], -1), poses, camera)


def test_rates_are_the_derivative_of_motions():
    poses, h = orbit(3), 1e-6
    for axis, unit in enumerate(torch.eye(6, dtype=DOUBLE)):
        step = h * unit.expand(3, 6)
        difference = (moved(poses, step) - moved(poses, -step)) / (2 * h)
        assert torch.allclose(pose_rates(poses)[axis], difference, atol=1e-8)


def test_motions_are_rotation_vectors_along_the_cameras_axes():
    poses, step = orbit(4), disturbance(4, 0.3)
    result = moved(poses, step)
    for pose, part, after in zip(poses.numpy(), step.numpy(), result.numpy(), strict=True):
        turned = pose[:3, :3] @ Rotation.from_rotvec(part[:3]).as_matrix()
        assert np.allclose(after[:3, :3], turned, atol=1e-12)
        assert np.allclose(after[:3, 3], pose[:3, 3] + pose[:3, :3] @ part[3:], atol=1e-12)
    angles = rotation_angle(result[:, :3, :3], poses[:, :3, :3])
    assert torch.allclose(angles, step[:, :3].norm(dim=-1), rtol=1e-9)


def test_the_loss_is_fairs():
    r = torch.tensor([-0.7, -1e-4, 1e-4, 0.05, 0.3], dtype=DOUBLE, requires_grad=True)
    (slope,) = torch.autograd.grad(fair_loss(r).sum(), r)
    assert torch.allclose(slope, r / (1 + r.abs() / FAIR))
    assert torch.allclose(fair_loss(r)[1:3], 0.5 * r[1:3].square(), rtol=2e-3)


def test_a_step_solves_the_weighted_least_squares():
    generator = torch.Generator().manual_seed(2)
    jacobian = torch.randn(2, 40, 6, dtype=DOUBLE, generator=generator)
    residual = torch.randn(2, 40, dtype=DOUBLE, generator=generator)
    step = gauss_newton_step(jacobian, residual)
    for a, r, found in zip(jacobian.numpy(), residual.numpy(), step.numpy(), strict=True):
        root = np.sqrt(1.0 / (1.0 + np.abs(r) / FAIR))
        weighted = root[:, None] * a
        damping = np.diag(np.sqrt(DAMPING * (weighted**2).sum(0)))
        rows, values = np.vstack([weighted, damping]), np.concatenate([root * r, np.zeros(6)])
        assert np.allclose(found, np.linalg.lstsq(rows, values, rcond=None)[0], rtol=1e-6)


def test_a_camera_that_sees_nothing_stays():
    step = gauss_newton_step(torch.zeros(1, 10, 6, dtype=DOUBLE), torch.ones(1, 10, dtype=DOUBLE))
    assert torch.equal(step, torch.zeros(1, 6, dtype=DOUBLE))


def test_a_similarity_of_all_cameras_is_undone():
    given = orbit(5)
    turn = torch.from_numpy(Rotation.from_rotvec([0.2, -0.5, 0.3]).as_matrix())
    drifted = given.clone()
    drifted[:, :3, :3] = turn @ given[:, :3, :3]
    drifted[:, :3, 3] = given[:, :3, 3] @ turn.T + torch.tensor([0.3, -0.1, 0.2], dtype=DOUBLE)
    assert torch.allclose(onto(drifted, given), given, atol=1e-12)
    larger = given.clone()
    larger[:, :3, 3] *= 1.02
    back = onto(larger, given)
    assert float((back[:, :3, 3].norm(dim=-1) / given[:, :3, 3].norm(dim=-1) - 1).abs().max()) < 0.01
    assert torch.allclose(torch.linalg.det(back[:, :3, :3]), torch.ones(5, dtype=DOUBLE))


def test_views_are_reduced_by_means(generator):
    images = torch.rand(2, 6, 8, 4, dtype=DOUBLE, generator=generator)
    known = torch.ones(2, 6, 8, dtype=torch.bool)
    known[0, 0, 0] = False
    views = PosedViews(images, orbit(2), PinholeCamera(8, 6, 0.7), known=known)
    small = reduce_views(views, 4)
    assert small.images.shape == (2, 3, 4, 4) and (small.camera.width, small.camera.height) == (4, 3)
    corner = images[1, 2:4, 6:8]
    assert torch.allclose(small.images[1, 1, 3, 3], corner[..., 3].mean())
    colour = (corner[..., :3] * corner[..., 3:]).sum((0, 1)) / corner[..., 3].sum()
    assert torch.allclose(small.images[1, 1, 3, :3], colour)
    assert small.known is not None and int((~small.known).sum()) == 1 and not small.known[0, 0, 0]
    assert reduce_views(views, 8) is views


def test_cameras_find_their_places_in_a_known_field(field):
    truth = orbit(6)
    views = shown(field, truth)
    wrong = moved(truth, disturbance(6, 0.03))
    poses, loss = align(field, replace(views, camera_to_world=wrong), 8, NerfRenderer())
    before, after = errors(wrong, truth), errors(poses, truth)
    assert after[0] < 0.05 * before[0] and after[1] < 0.05 * before[1]
    assert loss < 1e-3 * align(field, replace(views, camera_to_world=wrong), 0, NerfRenderer())[1]


def test_what_a_photograph_does_not_show_moves_no_camera(field):
    truth = orbit(3)
    views = shown(field, truth)
    spoilt = views.images.clone()
    spoilt[:, :, :10] = 0.0  # a stripe outside of the photograph, through the object
    known = torch.ones(3, 32, 32, dtype=torch.bool)
    known[:, :, :10] = False
    wrong = moved(truth, disturbance(3, 0.02))
    given = replace(views, images=spoilt, camera_to_world=wrong, known=known)
    poses, _ = align(field, given, 8, NerfRenderer())
    before, after = errors(wrong, truth), errors(poses, truth)
    assert after[0] < 0.1 * before[0] and after[1] < 0.1 * before[1]


def test_no_step_is_kept_that_raises_the_loss(field, monkeypatch):
    """Steps that turn the ball out of view leave cameras that are right where they are."""
    views = shown(field, orbit(2), size=16)
    away = torch.tensor([1.5, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=DOUBLE)
    monkeypatch.setattr(pose_refinement, "gauss_newton_step", lambda jacobian, residual: away.expand(2, 6))
    assert torch.equal(align(field, views, 2, NerfRenderer())[0], views.camera_to_world)


def test_none_by_default():
    views = PosedViews(torch.zeros(2, 4, 4, 4), orbit(2).float(), PinholeCamera(4, 4, 0.7))
    assert PoseRefinement().refine(views, 0) is views


def test_photographs_come_with_corrected_poses(tmp_path, caplog):
    """Of all cameras, and of nothing else."""
    made = capture(
        tmp_path, "can", count=10, width=64, height=48, renderer=RaycastRenderer(1), pose_noise=0.01
    )
    before = Photos(tmp_path).views("can", 8, 2, 48)
    poses = PoseRefinement(rounds=1, updates=2, image_size=32, steps=30, batch_rays=1024)
    with caplog.at_level("INFO"):
        after = Photos(tmp_path, refinement=poses).views("can", 8, 2, 48)
    assert len(after) == len(made.poses) - 1  # an eighth of ten photographs tests
    assert torch.equal(before.images, after.images) and after.camera == before.camera
    assert bool((after.camera_to_world != before.camera_to_world).flatten(1).any(1).all())
    rotation = after.camera_to_world[:, :3, :3]
    assert torch.allclose(rotation @ rotation.transpose(1, 2), torch.eye(3).expand_as(rotation), atol=1e-5)
    assert "9 cameras corrected" in caplog.text


@pytest.mark.slow
def test_fields_of_a_telephones_photographs_gain_decibels(tmp_path):
    """Positions off by a hundredth of the distance; three of 30 photographs score fields of both sets of poses."""
    capture(tmp_path, "drill", count=30, width=128, height=96, renderer=RaycastRenderer(1), pose_noise=0.01)

    def psnr(poses):
        views = Photos(tmp_path, refinement=poses).views("drill", 27, 3, 96)
        fitting = GridFitting(GridField(), resolution=128, refine_steps=(40,), prune_steps=(80,))
        generator = torch.Generator().manual_seed(0)
        return fit_field(views, fitting, generator, steps=120, held_out=3)[1][-1]["psnr_foreground"]

    assert psnr(PoseRefinement(rounds=6)) > psnr(None) + 3.0
