"""Fields on another device: the CPU's numbers bit for bit, with few trips between host and device."""

import dataclasses
import math
from functools import partial

import pytest
import torch
from trips import counted

from neural_sim import cameras, devices
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.fitting import BATCHES_PER_BLOCK, GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField, MLPFitting
from neural_sim.field.recipe import fit_field
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.types import PinholeCamera

CPU, DEVICE = torch.device("cpu"), torch.device("pretend", 0)
CAMERA = PinholeCamera(24, 24, math.radians(40.0))
GRID = partial(GridFitting, resolution=64, refine_steps=(8,), batch_rays=256, prune_rays=4096)
SAMPLING = {f"field/marching.py:{part}" for part in ("march", "_wave", "_enter", "add")} | {
    "field/fitting.py:_batches"
}


def _fit(views, device, make, held_out=0, steps=24):
    torch.manual_seed(0)  # of the colour head's layers
    fitting = make(device)
    generator = torch.Generator().manual_seed(0)
    return fit_field(views.to(device), fitting, generator, steps=steps, held_out=held_out)[0]


def _grid(device):
    return GRID(GridField().to(device))


def _grid_w(device):
    field = AppearanceField(code_size=4, head_width=8, learned=3, anchors=3).to(device)
    return AppearanceFitting(field, GRID)


def _photographs(device):
    """Codes of the views' own, fitted to held-out views too."""
    field = AppearanceField(code_size=4, head_width=8, view_dependent=True).to(device)
    return AppearanceFitting(field, GRID, anchors=2)


def _network(device):
    field = MLPField(width=8, depth=2, coarse_samples=4, fine_samples=4)
    return MLPFitting(field.to(device), batch_rays=64)


def _functions(lines):
    """``file:function`` of ledger places, which are ``file:line function``."""
    return {f"{place.split(':')[0]}:{place.split()[-1]}" for place in lines}


@pytest.fixture
def same_pieces(monkeypatch):
    """Work in the CPU's pieces, so that sums have its rounding."""
    monkeypatch.setattr(devices, "CACHES", 1)


@pytest.mark.parametrize("make", [_grid, _grid_w, _photographs, _network])
def test_a_field_is_fitted_as_on_the_cpu(lit_ball, pretend, same_pieces, make):
    views, steps = lit_ball(14, 0), 10 if make is _network else 24
    if make is _photographs:
        views = dataclasses.replace(views, light_weights=None)
    here, there = (_fit(views, device, make, held_out=2, steps=steps) for device in (CPU, DEVICE))
    for (name, want), got in zip(here.state_dict().items(), there.state_dict().values(), strict=True):
        assert got.device.type == "pretend" or name.endswith("cell")
        assert torch.equal(got.cpu(), want), name


def test_only_choosing_samples_makes_a_fit_wait(lit_ball, pretend, monkeypatch):
    counts, places, advance = [], set(), GridFitting.advance
    steps = 16 + 2 * BATCHES_PER_BLOCK + 1

    def counting(self, step):
        changed = advance(self, step)
        counts.append(pretend.count())
        if step == 16:
            pretend.trips.clear()  # past preparation and refinement
        if step == steps - 1:
            places.update(place for _, _, place in pretend.trips if place)
        return changed

    monkeypatch.setattr(GridFitting, "advance", counting)
    _fit(lit_ball(14, 0), DEVICE, _grid, steps=steps)
    assert _functions(places) <= SAMPLING
    block = counts[16 + BATCHES_PER_BLOCK] - counts[16]
    assert block <= 3 * BATCHES_PER_BLOCK
    # Within a block, whose samples are chosen, no step waits at all.
    steps = torch.tensor(counts[17 : 16 + BATCHES_PER_BLOCK + 1]).diff()
    assert (steps > 0).sum() <= 1


def _ball(lit_ball):
    views = lit_ball(14, 0)
    return _fit(views, CPU, _grid_w), views.camera_to_world[:4]


def test_renders_and_their_tangents_are_those_of_the_cpu(lit_ball, pretend, same_pieces):
    field, poses = _ball(lit_ball)
    rates = torch.randn(2, 4, 4, 4, generator=torch.Generator().manual_seed(1))
    weights = torch.tensor([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]])[[0, 1, 0, 0]]

    def made(device):
        there, at = field.to(device), poses.to(device)
        plain, lit = NerfRenderer(rays_per_chunk=300), NerfWRenderer()
        value, moved = lit.render_with_tangents(
            there, CAMERA, at, rates.to(device), weights, torch.eye(3)[:, None].expand(-1, 4, -1)
        )
        bundle = cameras.rays(CAMERA, at[0])
        rays = cameras.Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
        tensors = [*plain.render(there.grid, CAMERA, at), *lit.render(there, CAMERA, at, weights=weights)]
        tensors += [value.rgb, *(part for tangent in moved for part in (tangent.rgb, tangent.opacity))]
        tensors += lit.render_rays(there, rays, weights[0])
        return [x.cpu() for x in tensors]

    want = made(CPU)
    assert all(torch.equal(x, y) for x, y in zip(made(DEVICE), want, strict=True))


def test_a_render_waits_twice_a_view_and_four_times_a_wave(lit_ball, pretend):
    field, poses = _ball(lit_ball)
    there, at = field.grid.to(DEVICE), poses.repeat(4, 1, 1).to(DEVICE)
    with counted() as ledger:
        NerfRenderer().render(there, CAMERA, at)
    views = sum(
        n for (_, _, place), n in ledger.trips.items() if "screen.py" in place or "pixels.py" in place
    )
    assert views == 2 * len(at)
    assert ledger.count() - views <= 2 + 4 * 4  # two to enter the grid, few waves behind one another
