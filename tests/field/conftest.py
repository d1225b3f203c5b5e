"""A ball under varied light in closed form."""

import math
from collections.abc import Callable

import pytest
import torch

from neural_sim import cameras
from neural_sim.types import PinholeCamera, PosedViews

RADIUS = 0.6
TINTS = torch.tensor([[0.9, 0.5, 0.2], [0.2, 0.5, 0.9], [0.5, 0.9, 0.5]])
TOWARDS = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _lit_ball(count: int, seed: int, weights: torch.Tensor | None = None, size: int = 32) -> PosedViews:
    """A ball of changing colour under three tinted lights at given weights (else each in turn), in closed form."""
    generator = torch.Generator().manual_seed(seed)
    height, turn = torch.rand(2, count, generator=generator)
    pose = cameras.orbit(torch.arccos(1.0 - 2.0 * height), 2.0 * math.pi * turn, torch.full((count,), 2.8))
    camera = PinholeCamera(size, size, math.radians(40.0))
    bundle = cameras.rays(camera, pose)
    near, far = cameras.unit_sphere_span(bundle, RADIUS)
    normal = (bundle.origins + near[..., None] * bundle.directions) / RADIUS
    hit = (far > near)[..., None].float()
    weights = torch.eye(3)[torch.arange(count) % 3] if weights is None else weights
    facing = 0.3 + 0.7 * torch.einsum("nhwc,lc->nhwl", normal, TOWARDS).clamp_min(0.0)
    shade = torch.einsum("nhwl,nl,lc->nhwc", facing, weights, TINTS)
    albedo = 0.65 + 0.35 * normal[..., [1, 2, 0]]
    return PosedViews(torch.cat([albedo * shade * hit, hit], -1), pose, camera, weights)


def _colour_error(rendered: torch.Tensor, images: torch.Tensor) -> float:
    """Root mean square error of colour where the ball and all neighbours of the pixel are opaque in the truth."""
    inside = -torch.nn.functional.max_pool2d(-images[:, None, ..., 3], 3, 1, 1)[:, 0] > 0.5
    return float((rendered - images)[..., :3][inside].square().mean().sqrt())


@pytest.fixture(scope="session")
def lit_ball() -> Callable[..., PosedViews]:
    return _lit_ball


@pytest.fixture(scope="session")
def colour_error() -> Callable[[torch.Tensor, torch.Tensor], float]:
    return _colour_error
