"""The packed grid against torch's own dense interpolation, its refinement, derivatives and saved form."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional

from neural_sim.field.grid import GridField
from neural_sim.field.interpolation import interpolate, interpolate_for_training
from neural_sim.field.recipe import field_from_state, field_state


def random_field(generator: torch.Generator, occupied: torch.Tensor, head_width: int = 0) -> GridField:
    field = GridField(features=4 if head_width else 3, head_width=head_width).double()
    field.reset(occupied, torch.tensor([-1.0, -1.0, -1.0], dtype=torch.float64), 2.0 / occupied.shape[0])
    with torch.no_grad():
        field.table[:-1] = torch.randn(field.table[:-1].shape, generator=generator, dtype=torch.float64)
    return field.eval().requires_grad_(False)


def points(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 1.9 - 0.95


def test_interpolation_equals_grid_sample(generator: torch.Generator) -> None:
    size = 5
    field = random_field(generator, torch.ones(size, size, size, dtype=torch.bool))
    where = points(300, generator)
    dense = field.table[:-1].detach().view(1, size + 1, size + 1, size + 1, 4).permute(0, 4, 3, 2, 1)
    expected = functional.grid_sample(dense, where[None, :, None, None], align_corners=True)[
        0, :, :, 0, 0
    ].t()
    torch.testing.assert_close(field.raw(where), expected, atol=1e-12, rtol=0.0)


def test_density_is_zero_outside_the_occupied_cells(generator: torch.Generator) -> None:
    occupied = torch.zeros(6, 6, 6, dtype=torch.bool)
    occupied[1:3, 2:5, 4] = True
    field = random_field(generator, occupied)
    where = points(4000, generator) * 1.4
    cell = ((where + 1.0) * 3.0).floor().long()
    inside = ((cell >= 0) & (cell < 6)).all(-1)
    hit = inside & occupied[cell.clamp(0, 5).unbind(1)]
    sigma, rgb = field.query(where, where)
    assert torch.equal(sigma > 0.0, hit) and 0 < int(hit.sum()) < 4000
    assert float(rgb.min()) >= 0.0 and float(rgb.max()) <= 1.0


def test_refining_leaves_the_function_unchanged(generator: torch.Generator) -> None:
    occupied = torch.rand(6, 6, 6, generator=generator) < 0.4
    field = random_field(generator, occupied)
    where = points(3000, generator)
    before, rows = field.raw(where), len(field.table)
    field.keep(torch.ones(int(occupied.sum()), dtype=torch.bool), refine=True)
    assert len(field.table) > rows
    torch.testing.assert_close(field.raw(where), before, atol=1e-12, rtol=1e-12)


def test_pruning_drops_cells_beyond_the_margin(generator: torch.Generator) -> None:
    field = random_field(generator, torch.ones(8, 8, 8, dtype=torch.bool))
    cells = torch.zeros(8, 8, 8, dtype=torch.bool)
    cells[3, 3, 3] = True
    inside = torch.full((1, 3), -1.0 + 3.6 * 0.25, dtype=torch.float64)
    before = field.raw(inside)
    field.keep(cells.flatten(), refine=False)
    assert int(field.occupied.sum()) == 27
    torch.testing.assert_close(field.raw(inside), before, atol=1e-12, rtol=0.0)
    assert field.query(torch.full((1, 3), 0.9, dtype=torch.float64), inside)[0].item() == 0.0


@pytest.mark.parametrize("head_width", [0, 5])
def test_derivatives_in_position_and_direction(generator: torch.Generator, head_width: int) -> None:
    field = random_field(generator, torch.ones(4, 4, 4, dtype=torch.bool), head_width).requires_grad_(False)
    where = points(12, generator).requires_grad_()
    directions = functional.normalize(points(12, generator), dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(field.query, (where, directions), check_forward_ad=True)


def test_training_interpolation_has_the_same_value_and_table_gradient(generator: torch.Generator) -> None:
    table = torch.randn(20, 4, generator=generator, dtype=torch.float64).requires_grad_()
    corners = torch.randint(0, 20, (50, 8), generator=generator).int()
    weights = torch.rand(50, 8, generator=generator, dtype=torch.float64)
    cotangent = torch.randn(50, 4, generator=generator, dtype=torch.float64)
    expected = interpolate(table, corners, weights)
    (reference,) = torch.autograd.grad(expected, table, cotangent)
    value = interpolate_for_training(table, corners, weights)
    (gradient,) = torch.autograd.grad(value, table, cotangent)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(gradient, reference, atol=1e-12, rtol=0.0)


def test_saved_and_loaded_fields_are_the_same(generator: torch.Generator, tmp_path: Path) -> None:
    field = random_field(generator, torch.rand(5, 5, 5, generator=generator) < 0.5, head_width=3).float()
    torch.save(field_state(field), tmp_path / "field.pt")
    loaded = field_from_state(torch.load(tmp_path / "field.pt", weights_only=True))
    where = points(200, generator).float()
    for ours, theirs in zip(field.query(where, where), loaded.query(where, where), strict=True):
        assert torch.equal(ours, theirs)
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_a_field_of_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown kind"):
        field_from_state({"kind": "Voxels"})


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_type_too_coarse_for_places_in_a_cell_is_refused(dtype: torch.dtype) -> None:
    field = GridField()
    with pytest.raises(ValueError, match="float32 or float64"):
        field.to(dtype)
    assert field.table.dtype == field.origin.dtype == torch.float32
    assert field.double().table.dtype == torch.float64
