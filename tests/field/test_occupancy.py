"""Cells, distances and the walk of rays through them, against brute force."""

import pytest
import torch

from neural_sim.field.grid import GridField
from neural_sim.field.marching import lookup
from neural_sim.field.occupancy import COARSENING, build_occupancy, crop, subdivide
from neural_sim.types import Rays


def blob(generator: torch.Generator, size: int = 13, share: float = 0.03) -> torch.Tensor:
    occupied = torch.rand(size, size, size, generator=generator) < share
    occupied[2, 3, 4] = True
    return occupied


def field_with(occupied: torch.Tensor, cell: float, step_cells: float = 0.7) -> GridField:
    field = GridField(step_cells=step_cells).double()
    field.reset(occupied, torch.tensor([-1.0, -0.9, -1.1], dtype=torch.float64), cell)
    return field


def rays_towards_centre(count: int, generator: torch.Generator) -> Rays:
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins = 3.0 * origins / origins.norm(dim=-1, keepdim=True)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.5 - origins
    return Rays(origins, directions / directions.norm(dim=-1, keepdim=True))


def test_distances_never_exceed_the_nearest_occupied_coarse_cell(generator: torch.Generator) -> None:
    occupied = blob(generator, size=40, share=0.0)
    occupancy = build_occupancy(occupied, torch.zeros(3), 0.1)
    coarse = torch.tensor([2, 3, 4]) // COARSENING
    grid = torch.stack(
        torch.meshgrid(*[torch.arange(n) for n in occupancy.distance.shape], indexing="ij"), -1
    )
    assert torch.equal(occupancy.distance.long(), (grid - coarse).abs().amax(-1))


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="no cell is occupied"):
        build_occupancy(torch.zeros(2, 2, 2, dtype=torch.bool), torch.zeros(3), 1.0)


def test_marching_finds_every_lattice_point_in_an_occupied_cell(generator: torch.Generator) -> None:
    cell = 0.15
    field = field_with(blob(generator), cell)
    rays = rays_towards_centre(200, generator)
    samples, cells = field.sample_cells(rays, 0.0, 0.5)
    lattice = (torch.arange(400, dtype=torch.float64) + 0.5) * field.step
    points = rays.origins[:, None] + rays.directions[:, None] * lattice[:, None]
    found = lookup((points - field.origin) / cell, field.occupancy)
    ray, place = (found >= 0).nonzero().unbind(1)
    assert len(ray) > 100
    assert torch.equal(samples.ray, ray)
    torch.testing.assert_close(samples.distance, lattice[place], atol=1e-12, rtol=0.0)
    assert torch.equal(cells.long(), found[ray, place].long())
    assert torch.equal(samples.starts.diff(), torch.bincount(ray, minlength=200))


def test_rays_along_an_axis_and_rays_that_miss(generator: torch.Generator) -> None:
    field = field_with(torch.ones(4, 4, 4, dtype=torch.bool), 0.5)
    origins = torch.tensor([[-3.0, 0.05, 0.05], [-3.0, 5.0, 0.0]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    samples = field.sample(Rays(origins, directions), 0.0)
    # Steps of 0.35 from 0.175: five of them lie in the grid, which spans 2 to 4 along the ray.
    assert samples.starts.diff().tolist() == [5, 0]
    nothing = field.sample(Rays(origins[1:], directions[1:]), 1e-3)
    assert len(nothing) == 0 and nothing.starts.tolist() == [0, 0]


def test_a_camera_too_far_to_count_its_steps_is_refused_instead_of_walking_for_ever() -> None:
    field = GridField().eval()
    field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -1.0), 0.5)
    towards = torch.tensor([[-1.0, 0.0, 0.0]])
    assert len(field.sample(Rays(torch.tensor([[1e6, 0.1, 0.2]]), towards), 0.0)) > 0
    with pytest.raises(ValueError, match="closer"):
        field.sample(Rays(torch.tensor([[1e8, 0.1, 0.2]]), towards), 0.0)
    assert len(field.sample(Rays(torch.tensor([[1e8, 9.0, 9.0]]), towards), 0.0)) == 0


def test_termination_drops_only_what_light_does_not_reach(generator: torch.Generator) -> None:
    field = field_with(torch.ones(8, 8, 8, dtype=torch.bool), 0.25)
    with torch.no_grad():
        field.table[:-1, 0] = 0.3 + torch.rand(len(field.table) - 1, generator=generator, dtype=torch.float64)
    rays = rays_towards_centre(50, generator)
    every, some = field.sample(rays, 0.0), field.sample(rays, 1e-2)
    assert 0 < len(some) < len(every)
    for ray in range(50):
        short = some.distance[some.starts[ray] : some.starts[ray + 1]]
        long = every.distance[every.starts[ray] : every.starts[ray + 1]]
        assert torch.equal(short, long[: len(short)])
        sigma, _ = field.query(
            rays.origins[ray] + rays.directions[ray] * long[:, None],
            rays.directions[ray].expand(len(long), 3),
        )
        light = torch.exp(-(sigma.cumsum(0) - sigma) * field.step)
        assert len(short) == int((light > 1e-2).sum())


def test_crop_and_subdivide_keep_the_same_space(generator: torch.Generator) -> None:
    occupied = torch.zeros(6, 6, 6, dtype=torch.bool)
    occupied[2:4, 1, 5] = True
    inside, origin = crop(occupied, torch.zeros(3), 0.5)
    assert inside.shape == (2, 1, 1) and origin.tolist() == [1.0, 0.5, 2.5]
    assert subdivide(inside).shape == (4, 2, 2) and bool(subdivide(inside).all())
