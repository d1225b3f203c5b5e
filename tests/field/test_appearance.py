"""Fields with appearance codes: geometry that no code moves, derivatives with respect to code and camera, saving."""

from pathlib import Path

import pytest
import torch

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.recipe import field_from_state, field_state
from neural_sim.field.rendering import render_packed
from neural_sim.types import Rays

DOUBLE = torch.float64


def normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=generator, dtype=DOUBLE)


def random_field(generator: torch.Generator, view_dependent: bool = False) -> AppearanceField:
    torch.manual_seed(0)  # the head's linear layers
    field = AppearanceField(features=4, head_width=8, code_size=5, view_dependent=view_dependent).double()
    occupied = torch.rand(5, 5, 5, generator=generator) < 0.7
    field.grid.reset(occupied, torch.full((3,), -1.0, dtype=DOUBLE), 0.4)
    field.reset_codes(torch.softmax(normal(generator, 3, 7), 1), generator)
    with torch.no_grad():
        field.grid.table[:-1] = normal(generator, *field.grid.table[:-1].shape)
        field.codes.copy_(normal(generator, 7, 5))
    return field.eval().requires_grad_(False)


def bundle(generator: torch.Generator, count: int) -> Rays:
    origins = torch.nn.functional.normalize(normal(generator, count, 3), dim=-1) * 3.0
    inside = 1.2 * torch.rand((count, 3), generator=generator, dtype=DOUBLE) - 0.6
    return Rays(origins, torch.nn.functional.normalize(inside - origins, dim=-1))


def test_opacity_is_bitwise_the_same_under_any_code(generator: torch.Generator) -> None:
    field, rays = random_field(generator), bundle(generator, 300)
    rgb, opacity = render_packed(field, rays, 1e-3)
    assert 0.1 < float(opacity.mean()) < 1.0
    for code in 100.0 * normal(generator, 4, 5):
        lit_rgb, lit_opacity = render_packed(field.lit(code), rays, 1e-3)
        assert torch.equal(lit_opacity, opacity) and not torch.equal(lit_rgb, rgb)


def test_opacity_has_no_derivative_by_the_code(generator: torch.Generator) -> None:
    field, rays = random_field(generator), bundle(generator, 50)
    code = normal(generator, 5).requires_grad_()
    rgb, opacity = render_packed(field.lit(code), rays, 0.0)
    (by_colour,) = torch.autograd.grad(rgb.sum(), code, retain_graph=True)
    (by_opacity,) = torch.autograd.grad(opacity.sum(), code)
    assert by_colour.abs().min() > 0.0 and not by_opacity.any()


def test_the_fields_own_query_is_under_the_mean_anchor(generator: torch.Generator) -> None:
    field, positions = random_field(generator), 0.9 * normal(generator, 40, 3)
    expected = field.lit(field.anchors.mean(0)).query(positions, positions)
    torch.testing.assert_close(field.query(positions, positions), expected, rtol=0, atol=1e-14)
    torch.testing.assert_close(field.anchors, field.mixing @ field.codes)


def test_one_gain_for_all_samples_equals_a_gain_each(generator: torch.Generator) -> None:
    field, raw = random_field(generator), normal(generator, 30, 5)
    gain = field.gain(normal(generator, 5))
    together = field.decode(raw, raw[:, :3], gain)
    torch.testing.assert_close(together, field.decode(raw, raw[:, :3], gain.expand(30, -1)))


@pytest.mark.parametrize("view_dependent", [False, True])
def test_tangents_by_camera_and_code(view_dependent: bool, generator: torch.Generator) -> None:
    """Against generic forward mode, and central differences for the code."""
    field = random_field(generator, view_dependent)
    positions = torch.rand(200, 3, generator=generator, dtype=DOUBLE) * 2.0 - 1.0
    directions = torch.nn.functional.normalize(normal(generator, 200, 3), dim=-1)
    velocities, turns = normal(generator, 2, 200, 3), normal(generator, 2, 200, 3)
    code, code_rates = normal(generator, 5), normal(generator, 3, 5)
    sigma, rgb, sigma_rates, rgb_rates = field.lit(code, code_rates).query_with_tangents(
        positions, directions, velocities, turns
    )
    assert len(sigma_rates) == 2 and len(rgb_rates) == 5
    torch.testing.assert_close((sigma, rgb), field.lit(code).query(positions, directions))
    for m in range(2):
        _, expected = torch.func.jvp(
            field.lit(code).query, (positions, directions), (velocities[m], turns[m])
        )
        torch.testing.assert_close((sigma_rates[m], rgb_rates[m]), expected, rtol=1e-10, atol=1e-10)
    for q in range(3):
        _, expected = torch.func.jvp(
            lambda c: field.lit(c).query(positions, directions)[1], (code,), (code_rates[q],)
        )
        torch.testing.assert_close(rgb_rates[2 + q], expected, rtol=1e-10, atol=1e-12)
        ahead, behind = (
            field.lit(code + h * code_rates[q]).query(positions, directions)[1] for h in (1e-6, -1e-6)
        )
        torch.testing.assert_close(rgb_rates[2 + q], (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-8)
    assert float(rgb_rates[2:].abs().max()) > 0.01


def test_it_survives_saving(generator: torch.Generator, tmp_path: Path) -> None:
    field = random_field(generator).float()
    torch.save(field_state(field), tmp_path / "field.pt")
    loaded = field_from_state(torch.load(tmp_path / "field.pt", weights_only=True))
    assert isinstance(loaded, AppearanceField) and torch.equal(loaded.anchors, field.anchors)
    where = torch.rand(50, 3, generator=generator)
    assert torch.equal(loaded.query(where, where)[1], field.query(where, where)[1])
