"""Contracted space and the samples of rays in it, against closed forms and fine integration."""

import math

import numpy as np
import pytest
import torch

from neural_sim.field.scene.space import Frame, along_rays, contract, expand, looked_at


def test_the_contraction_is_mip_nerf_360s(generator):
    """Eq. 10: x inside of the unit ball, (2 - 1 / |x|) x / |x| outside."""
    inside = 0.57 * torch.rand(50, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(contract(inside), inside)
    outside = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    length = torch.logspace(0.01, 4.0, 50, dtype=torch.float64)
    outside = outside / outside.norm(dim=-1, keepdim=True)
    want = (2.0 - 1.0 / length)[:, None] * outside
    torch.testing.assert_close(contract(length[:, None] * outside), want)


def test_expand_is_its_inverse(generator):
    points = (
        torch.randn(200, 3, generator=generator, dtype=torch.float64) * torch.logspace(-2, 3, 200)[:, None]
    )
    torch.testing.assert_close(expand(contract(points)), points, rtol=1e-9, atol=1e-12)


def test_samples_lie_on_their_rays_and_widths_are_lengths(generator):
    """Positions against the ray's line, widths against the length of the contracted curve, finely integrated."""
    origins = torch.tensor([[0.0, -2.1, 0.7], [0.0, 0.0, 3.0]], dtype=torch.float64)
    directions = torch.tensor([[0.1, 1.0, -0.3], [0.0, 0.2, -1.0]], dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    count = 400
    phase = torch.rand(2, generator=generator, dtype=torch.float64)
    positions, width = along_rays(origins, directions, phase, count)
    assert positions.shape == (2, count, 3) and width.shape == (2, count)
    points = expand(positions)
    along = ((points - origins[:, None]) * directions[:, None]).sum(-1)
    off = (points - origins[:, None] - along[..., None] * directions[:, None]).norm(dim=-1)
    near = points.norm(dim=-1) < 4.0
    assert float(off[near].max()) < 1e-3  # a chord's middle lies off its arc by the square of its length
    assert bool((along.diff(dim=1) > 0.0).all())
    distance = torch.cat(
        [torch.linspace(0.0, 8.0, 40_001), torch.logspace(math.log10(8.0), 6.0, 20_001)]
    ).double()
    curve = contract(origins[:, None] + directions[:, None] * distance[:, None])
    whole = (curve[:, 1:] - curve[:, :-1]).norm(dim=-1)
    covered = (distance[1:] > 1.5) & (distance[1:] < 10.0)
    ours = width.where((along > 1.5) & (along < 10.0), torch.tensor(0.0).double()).sum(1)
    # The first and the last interval of the window are counted whole or not at all.
    torch.testing.assert_close(ours, (whole * covered).sum(1), rtol=0.0, atol=2.0 * float(width.max()))


def test_the_unit_ball_has_most_samples_and_equal_steps():
    origins, directions = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    positions, width = along_rays(origins, directions, torch.zeros(1), 96)
    inside = positions[0].norm(dim=-1) < 1.0
    assert float(inside.float().mean()) > 0.5
    # dt = h dtheta / cos^2 theta: within the ball, |t - m| <= 1 = h, steps differ by at most a factor of two.
    assert float(width[0][inside].max() / width[0][inside].min()) < 2.1


def test_a_frame_goes_in_and_out():
    frame = Frame((1.0, -2.0, 0.5), 0.25)
    points = np.array([[1.0, -2.0, 0.5], [1.25, -2.0, 0.0]])
    np.testing.assert_allclose(frame.into(torch.from_numpy(points)).numpy(), [[0, 0, 0], [1, 0, -2]])
    np.testing.assert_allclose(frame.out(frame.into(torch.from_numpy(points)).numpy()), points)


def looking(centres, target):
    """Poses with these centres that look at a point."""
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    for pose, centre in zip(poses, centres, strict=True):
        backward = (centre - target) / np.linalg.norm(centre - target)
        right = np.cross([0.3, 0.2, 1.0], backward)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.column_stack([right, np.cross(backward, right), backward])
        pose[:3, 3] = centre
    return poses


def test_the_point_that_cameras_look_at(generator):
    target = np.array([0.4, -1.0, 2.0])
    centres = target + 3.0 * np.random.default_rng(0).normal(size=(9, 3))
    point, distance = looked_at(looking(centres, target), "can")
    np.testing.assert_allclose(point, target, atol=1e-9)
    assert distance == pytest.approx(np.median(np.linalg.norm(centres - target, axis=1)))


@pytest.mark.parametrize("outwards", [True, False])
def test_cameras_that_look_at_no_one_place_are_refused(outwards):
    centres = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.2]])
    poses = looking(centres, np.zeros(3))
    if outwards:
        poses[:, :3, :3] = poses[:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    else:
        poses[:, :3, :3] = poses[0, :3, :3]
    with pytest.raises(
        ValueError, match=r"objects\.masks=scene: the cameras of can do not look.*objects\.box"
    ):
        looked_at(poses, "can")
