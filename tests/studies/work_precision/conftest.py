"""One small field before clutter, a detector that was never trained, and v: what families are given in tests."""

import math
from types import SimpleNamespace

import pytest
import torch

from neural_sim import cameras
from neural_sim.field.grid import GridField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera, PosedViews


def block(seed=1, cells=12, opacity=1.0):
    """A textured block of ``cells``^3 cells."""
    field = GridField().eval()
    field.reset(torch.ones(cells, cells, cells, dtype=torch.bool), torch.full((3,), -0.3), 0.6 / cells)
    noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        field.table.copy_(0.3 * noise)
        field.table[:-1, 0] += opacity / 2.0
        field.table[-1, 0] = -1e4
    return field.requires_grad_(False)


@pytest.fixture(scope="session")
def small_world():
    field = block()
    camera = PinholeCamera(16, 16, math.radians(40.0))
    pose = cameras.orbit(
        torch.tensor([1.0, 1.6, 2.1, 0.7]), torch.tensor([0.2, 1.0, -0.5, 2.0]), torch.full((4,), 3.0)
    )
    rgb, opacity = NerfRenderer().render(field, camera, pose, exact=True)
    straight = rgb / opacity.clamp_min(1e-6)[..., None]
    views = PosedViews(torch.cat([straight, opacity[..., None]], -1), pose, camera)
    return SimpleNamespace(names=("block",), views=views, held_out=2)
