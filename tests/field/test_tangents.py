"""Derivatives that ride along with a render, in closed form, against generic forward mode and central differences."""

import pytest
import torch

from neural_sim.field.base import RadianceField
from neural_sim.field.grid import GridField
from neural_sim.field.interpolation import gather_weighted, interpolate, trilinear_tangents, trilinear_weights
from neural_sim.field.mlp import MLPField
from neural_sim.field.quadrature import (
    PackedSamples,
    composite,
    composite_with_gradient,
    composite_with_tangents,
)
from neural_sim.field.rendering import render_samples, render_with_tangents
from neural_sim.types import Rays

DOUBLE = torch.float64


def normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=generator, dtype=DOUBLE)


def grid(generator: torch.Generator, head_width: int) -> GridField:
    field = GridField(features=4 if head_width else 3, head_width=head_width).double()
    occupied = torch.rand(5, 5, 5, generator=generator) < 0.7  # some of the points fall into empty cells
    field.reset(occupied, torch.full((3,), -1.0, dtype=DOUBLE), 0.4)
    with torch.no_grad():
        field.table[:-1] = normal(generator, *field.table[:-1].shape)
    return field.eval().requires_grad_(False)


def test_weights_and_their_rates(generator: torch.Generator) -> None:
    fraction, velocities = torch.rand(50, 3, generator=generator, dtype=DOUBLE), normal(generator, 2, 50, 3)
    weights, rates = trilinear_tangents(fraction, velocities)
    torch.testing.assert_close(weights, trilinear_weights(fraction), rtol=0.0, atol=1e-15)
    for velocity, rate in zip(velocities, rates, strict=True):
        _, expected = torch.func.jvp(trilinear_weights, (fraction,), (velocity,))
        torch.testing.assert_close(rate, expected, rtol=0.0, atol=1e-14)


def test_the_fused_gather_equals_interpolation(generator: torch.Generator) -> None:
    table, corners = normal(generator, 30, 4), torch.randint(30, (20, 8), generator=generator)
    weights = normal(generator, 20, 8)
    torch.testing.assert_close(
        gather_weighted(table, corners.int(), weights), interpolate(table, corners, weights)
    )


@pytest.mark.parametrize("kind", ["grid", "grid with a head", "network"])
def test_a_query_with_tangents_is_the_query_and_its_derivatives(
    kind: str, generator: torch.Generator
) -> None:
    field: RadianceField
    if kind == "network":
        field = MLPField(width=16, depth=2, position_frequencies=3).double().eval().requires_grad_(False)
    else:
        field = grid(generator, 8 if "head" in kind else 0)
    positions = torch.rand(200, 3, generator=generator, dtype=DOUBLE) * 2.0 - 1.0
    directions = torch.nn.functional.normalize(normal(generator, 200, 3), dim=-1)
    velocities, turns = normal(generator, 2, 200, 3), normal(generator, 2, 200, 3)
    sigma, rgb, sigma_rates, rgb_rates = field.query_with_tangents(positions, directions, velocities, turns)
    expected = field.query(positions, directions)
    torch.testing.assert_close((sigma, rgb), expected, rtol=1e-12, atol=1e-12)
    step = 1e-7
    for m in range(2):
        _, generic = torch.func.jvp(field.query, (positions, directions), (velocities[m], turns[m]))
        torch.testing.assert_close((sigma_rates[m], rgb_rates[m]), generic, rtol=1e-10, atol=1e-10)
        ahead = field.query(positions + step * velocities[m], directions + step * turns[m])
        behind = field.query(positions - step * velocities[m], directions - step * turns[m])
        slopes = [(a - b) / (2.0 * step) for a, b in zip(ahead, behind, strict=True)]
        torch.testing.assert_close((sigma_rates[m], rgb_rates[m]), tuple(slopes), rtol=1e-5, atol=1e-5)
    assert float(rgb_rates.abs().max()) > 0.1


@pytest.mark.parametrize("kind", ["grid", "grid with a head", "network"])
def test_many_rates_of_rays_equal_forward_mode(kind: str, generator: torch.Generator) -> None:
    """Rates enough to be taken through a ray's six numbers, in pieces of a few rays."""
    field: RadianceField
    if kind == "network":
        field = MLPField(width=16, depth=2, position_frequencies=3).double().eval().requires_grad_(False)
    else:
        field = grid(generator, 8 if "head" in kind else 0)
    directions = torch.nn.functional.normalize(normal(generator, 40, 3), dim=-1)
    rays = Rays(0.3 * normal(generator, 40, 3) - 2.5 * directions, directions)
    rates = Rays(normal(generator, 4, 40, 3), normal(generator, 4, 40, 3))
    pixels, moved = render_with_tangents(field, rays, rates, 0.0, samples_at_once=60)
    samples = field.sample(rays, 0.0)

    def rgba(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        colour, opacity = render_samples(field, Rays(origins, directions), samples)
        return torch.cat([colour, opacity[:, None]], -1)

    torch.testing.assert_close(pixels, rgba(rays.origins, directions), rtol=0.0, atol=1e-12)
    for m in range(4):
        ways = (rates.origins[m], rates.directions[m])
        _, generic = torch.func.jvp(rgba, (rays.origins, directions), ways)
        torch.testing.assert_close(moved[m], generic, rtol=1e-9, atol=1e-10)
        assert float(generic.abs().max()) > 0.1


@pytest.mark.parametrize("scale", [0.5, 8.0, 500.0])
def test_the_quadratures_tangents(scale: float, generator: torch.Generator) -> None:
    counts = torch.tensor([0, 5, 1, 0, 7, 0])
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    ray = torch.arange(6).repeat_interleave(counts)
    width = 0.1 + torch.rand(13, generator=generator, dtype=DOUBLE)
    samples = PackedSamples(ray, torch.zeros(13, dtype=DOUBLE), width, starts)
    sigma = scale * torch.rand(13, generator=generator, dtype=DOUBLE)
    rgb = torch.rand(13, 3, generator=generator, dtype=DOUBLE)
    sigma_rates, rgb_rates = normal(generator, 3, 13), normal(generator, 3, 13, 3)
    pixels, rates = composite_with_tangents(sigma, rgb, sigma_rates, rgb_rates, samples)

    def rgba(sigma: torch.Tensor, rgb: torch.Tensor) -> torch.Tensor:
        colour, opacity = composite(sigma, rgb, samples)
        return torch.cat([colour, opacity[:, None]], -1)

    torch.testing.assert_close(pixels, rgba(sigma, rgb), rtol=0.0, atol=1e-15)
    for m in range(3):
        _, generic = torch.func.jvp(rgba, (sigma, rgb), (sigma_rates[m], rgb_rates[m]))
        torch.testing.assert_close(rates[m], generic, rtol=1e-12, atol=1e-13)
    # In space: the same rates for all samples, and in proportion to their distances.
    distance = 1.0 + torch.rand(13, generator=generator, dtype=DOUBLE)
    along = PackedSamples(ray, distance, width, starts)
    more = normal(generator, 2, 13, 3)
    again, by_origin, by_direction, of_colour = composite_with_gradient(
        sigma, rgb, sigma_rates, torch.cat([rgb_rates, more]), along
    )
    torch.testing.assert_close(again, pixels, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(by_origin, rates, rtol=1e-12, atol=1e-12)
    for m in range(3):
        further = (distance * sigma_rates[m], distance[:, None] * rgb_rates[m])
        _, generic = torch.func.jvp(rgba, (sigma, rgb), further)
        torch.testing.assert_close(by_direction[m], generic, rtol=1e-12, atol=1e-12)
    for rate, moved in zip(more, of_colour, strict=True):
        _, generic = torch.func.jvp(rgba, (sigma, rgb), (torch.zeros_like(sigma), rate))
        torch.testing.assert_close(moved, generic[:, :3], rtol=1e-12, atol=1e-12)
