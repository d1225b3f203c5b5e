"""The loss of a scene's field: its gradient against central differences in float64, and what the fit is robust to."""

import pytest
import torch

from neural_sim.field.scene.fitting import Budget, ScenePixels, fit, loss_of, visible
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.space import Frame
from neural_sim.types import Rays

RAYS = 12


@pytest.fixture
def small(generator):
    """A grid of 4^3 cells in float64 with random rows, and rays through its middle."""
    table = torch.randn(125, 4, generator=generator, dtype=torch.float64)
    table[:, 0] = 0.5 * table[:, 0] - 0.5
    grid = SceneGrid(4, table)
    origins = torch.randn(RAYS, 3, generator=generator, dtype=torch.float64)
    origins = 2.0 * origins / origins.norm(dim=-1, keepdim=True)
    towards = 0.5 * torch.randn(RAYS, 3, generator=generator, dtype=torch.float64) - origins
    rays = Rays(origins, towards / towards.norm(dim=-1, keepdim=True))
    numbers = [torch.rand(RAYS, 3, generator=generator, dtype=torch.float64) for _ in range(3)]
    return grid, rays, torch.rand(RAYS, generator=generator, dtype=torch.float64), numbers


def test_the_gradient_of_the_loss(small):
    grid, rays, phase, (colours, gain, behind) = small
    gain = (0.4 * (gain - 0.5)).requires_grad_(True)
    seen = visible(grid, rays, phase, 40)
    assert len(seen.samples) > 5 * RAYS
    vertices = torch.arange(0, 125, 3)

    def loss():
        return loss_of(grid, seen, colours, gain, behind, vertices)

    grid.table.requires_grad_(True)
    by_table, by_gain = torch.autograd.grad(loss(), [grid.table, gain])
    step = 1e-6
    for tensor, gradient in ((grid.table, by_table), (gain, by_gain)):
        flat, checked = tensor.detach().view(-1), gradient.flatten()
        largest = checked.abs().topk(20).indices
        for entry in torch.cat([largest, torch.arange(0, len(flat), 37)]).tolist():
            ends = []
            for sign in (1.0, -1.0):
                flat[entry] += sign * step
                with torch.no_grad():
                    ends.append(float(loss()))
                flat[entry] -= sign * step
            # Central differences are known to step^2 times a third derivative of order 1, and to rounding / step.
            assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(
                float(checked[entry]), abs=1e-9, rel=1e-5
            )


def test_total_variation_of_a_step(generator):
    """A half space that absorbs all: the difference is 1 along one axis at one layer of vertices, else 0."""
    table = torch.zeros(9, 9, 9, 4, dtype=torch.float64)
    table[:4, ..., 0], table[4:, ..., 0] = -100.0, 100.0
    grid = SceneGrid(8, table.view(-1, 4))
    every = torch.arange(9**3).view(9, 9, 9)[:8, :8, :8].reshape(-1)
    layer = 1.0 / 8.0
    got = float(grid.variation(every))
    assert got == pytest.approx(layer, abs=1.1e-3)  # the root's 1e-6 adds at most 1e-3


def test_only_empty_cells_and_what_is_behind_a_surface_are_left_out(small):
    """Weights of a ray's samples are those without leaving any out, up to the light that is left there."""
    grid, rays, phase, _ = small
    table = grid.table.clone()
    table[:60, 0], table[60:, 0] = -20.0, 4.0
    whole = SceneGrid(4, table)
    everything = visible(whole, rays, phase, 40)
    whole.mark()
    less = visible(whole, rays, phase, 40)
    assert 0 < len(less.samples) < len(everything.samples)
    from neural_sim.field.quadrature import composite

    opacities = []
    for seen in (everything, less):
        raw = whole.raw(seen.corners, seen.weights)
        opacities.append(composite(whole.density(raw[:, 0]), torch.sigmoid(raw[:, 1:]), seen.samples)[1])
    torch.testing.assert_close(*opacities, atol=5e-3, rtol=0.0)


def test_refining_keeps_the_field(small):
    grid = small[0]
    finer = grid.refined()
    assert finer.resolution == 8 and finer.table.shape == (9**3, 4)
    points = 1.9 * (
        2.0 * torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1.0
    )
    coarse = grid.raw(*grid.corners(points))
    # Trilinear within a coarse cell is trilinear in each of its halves.
    torch.testing.assert_close(finer.raw(*finer.corners(points)), coarse)


def test_exposures_are_told_apart(generator):
    """One grey wall all round, in two exposures: after the fit each has its own factor, and their ratio is true."""
    directions = torch.randn(3000, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    photo = torch.arange(3000) % 2
    colours = torch.tensor([0.4, 0.6])[photo][:, None].expand(-1, 3).contiguous()
    pixels = ScenePixels(
        torch.zeros(3000, 3, dtype=torch.float64), directions, colours, photo, torch.zeros(3000)
    )
    fitted = fit(pixels, Frame((0.0, 0.0, 0.0), 1.0), Budget(120, 512, 16), generator)
    ratio = (fitted.log_gain[1] - fitted.log_gain[0]).exp()
    torch.testing.assert_close(ratio, torch.full((3,), 1.5), rtol=0.05, atol=0.0)
