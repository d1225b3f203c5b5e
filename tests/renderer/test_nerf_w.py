"""The renderer of fields with appearance codes: weights of anchors; derivatives of camera and weights."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.grid import GridField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.types import PinholeCamera, Rays

DOUBLE = torch.float64
CAMERA = PinholeCamera(7, 7, math.radians(40.0))


@pytest.fixture
def field(generator: torch.Generator) -> AppearanceField:
    """A soft ball with random colours, zero density at the border of the occupied cells."""
    torch.manual_seed(0)
    field = AppearanceField(features=5, head_width=8, code_size=6, step_cells=0.5, density_gain=1.0).double()
    field.grid.reset(torch.ones(12, 12, 12, dtype=torch.bool), torch.full((3,), -1.2, dtype=DOUBLE), 0.2)
    place = torch.meshgrid(*[torch.linspace(-1.2, 1.2, 13, dtype=DOUBLE)] * 3, indexing="ij")
    field.reset_codes(torch.eye(4, dtype=DOUBLE), generator)
    with torch.no_grad():
        radius = torch.stack(place, -1).flatten(0, 2).norm(dim=-1)
        field.grid.table[:-1, 0] = (6.0 - 12.0 * radius).clamp_min(-40.0)
        field.grid.table[:-1, 1:] = torch.randn(13**3, 5, generator=generator, dtype=DOUBLE)
        field.codes.copy_(torch.randn(4, 6, generator=generator, dtype=DOUBLE))
    return field.eval().requires_grad_(False)


def poses(count: int = 3) -> torch.Tensor:
    angles = torch.linspace(0.3, 2.6, count, dtype=DOUBLE)
    return cameras.orbit(angles, 0.5 * angles, angles * 0.2 + 2.5)


def some_weights(generator: torch.Generator, count: int) -> torch.Tensor:
    weights = torch.randn((count, 4), generator=generator, dtype=DOUBLE)
    return weights - (weights.mean(-1, keepdim=True) - 0.25)


def flat(bundle: Rays) -> Rays:
    return Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))


def test_views_have_the_colour_of_their_weights_and_one_opacity(
    field: AppearanceField, generator: torch.Generator
) -> None:
    renderer, weights = NerfWRenderer(), some_weights(generator, 3)[[0, 1, 0]]
    rgb, opacity = renderer.render(field, CAMERA, poses(), weights=weights)
    for i in range(3):
        code = weights[i] @ field.codes
        alone, _ = super(NerfWRenderer, renderer).render_rays(
            field.lit(code), flat(cameras.rays(CAMERA, poses()[i]))
        )
        torch.testing.assert_close(rgb[i].reshape(-1, 3), alone, rtol=0, atol=1e-12)
    other_rgb, other_opacity = renderer.render(field, CAMERA, poses())
    torch.testing.assert_close(opacity, other_opacity, rtol=0, atol=1e-12)  # sums in another order
    assert not torch.allclose(rgb, other_rgb, atol=1e-2)
    equal = torch.full((3, 4), 0.25, dtype=DOUBLE)
    torch.testing.assert_close(other_rgb, renderer.render(field, CAMERA, poses(), weights=equal)[0])


def test_opacity_is_bitwise_the_same_under_any_weights(
    field: AppearanceField, generator: torch.Generator
) -> None:
    field = field.float()
    maps = [
        NerfWRenderer().render(field, CAMERA, poses().float(), weights=10.0 * row.float().expand(3, -1))
        for row in some_weights(generator, 4)
    ]
    for rgb, opacity in maps[1:]:
        assert torch.equal(opacity, maps[0][1]) and not torch.equal(rgb, maps[0][0])


@pytest.mark.parametrize("rays_per_chunk", [30, 10_000])
@pytest.mark.parametrize("camera_rates", [0, 1, 3])
def test_tangents_by_camera_and_weights(
    field: AppearanceField, generator: torch.Generator, rays_per_chunk: int, camera_rates: int
) -> None:
    """Against central differences of whole views; views 0 and 2 share weights but not the weights' rates."""
    renderer = NerfWRenderer(termination=0.0, rays_per_chunk=rays_per_chunk)
    phi = torch.linspace(0.3, 2.6, 3, dtype=DOUBLE)
    _, rate = torch.func.jvp(
        lambda angle: cameras.orbit(angle, 0.5 * phi, phi * 0.2 + 2.5), (phi,), (torch.ones_like(phi),)
    )
    rates = torch.arange(1.0, 1.0 + camera_rates, dtype=DOUBLE)[:, None, None, None] * rate
    weights = some_weights(generator, 3)[[0, 1, 0]]
    weight_rates = torch.randn((2, 3, 4), generator=generator, dtype=DOUBLE)
    maps, tangents = renderer.render_with_tangents(field, CAMERA, poses(), rates, weights, weight_rates)
    expected = renderer.render(field, CAMERA, poses(), weights=weights)
    torch.testing.assert_close((maps.rgb, maps.opacity), expected, rtol=0, atol=1e-12)
    assert len(tangents) == len(rates) + 2
    moves = [
        lambda h, speed=speed: renderer.render(
            field, CAMERA, cameras.orbit(phi + speed * h, 0.5 * phi, phi * 0.2 + 2.5), weights=weights
        )
        for speed in range(1, 1 + camera_rates)
    ]
    moves += [
        lambda h, rate=rate: renderer.render(field, CAMERA, poses(), weights=weights + h * rate)
        for rate in weight_rates
    ]
    for move, tangent in zip(moves, tangents, strict=True):
        slopes = tuple((a - b) / 2e-6 for a, b in zip(move(1e-6), move(-1e-6), strict=True))
        torch.testing.assert_close((tangent.rgb, tangent.opacity), slopes, rtol=1e-4, atol=1e-5)
        assert float(tangent.rgb.abs().max()) > 0.01
    assert not tangents[-1].opacity.any() and not tangents[-2].opacity.any()


def test_tangents_equal_forward_mode_through_the_rays(
    field: AppearanceField, generator: torch.Generator
) -> None:
    renderer = NerfWRenderer()
    weights, rate = some_weights(generator, 2)
    still = torch.zeros(0, 1, 4, 4, dtype=DOUBLE)
    _, (tangent,) = renderer.render_with_tangents(
        field, CAMERA, poses(1), still, weights[None], rate[None, None]
    )
    rays = flat(cameras.rays(CAMERA, poses(1)))
    _, (rgb_rate, opacity_rate) = torch.func.jvp(
        lambda w: renderer.render_rays(field, rays, w), (weights,), (rate,)
    )
    torch.testing.assert_close(tangent.rgb.reshape(-1, 3), rgb_rate, rtol=1e-10, atol=1e-12)
    assert not opacity_rate.any()


def test_reverse_mode_in_the_weights(field: AppearanceField, generator: torch.Generator) -> None:
    """Shared weights and a row of them for each ray, against central differences."""
    renderer, rays = NerfWRenderer(termination=0.0), flat(cameras.rays(CAMERA, poses(2)))
    cotangent = torch.randn((len(rays.origins), 3), generator=generator, dtype=DOUBLE)
    each = some_weights(generator, len(rays.origins))
    for weights in (each[0], each):
        leaf = weights.clone().requires_grad_()
        rgb, opacity = renderer.render_rays(field, rays, leaf)
        (by_opacity,) = torch.autograd.grad(opacity.sum(), leaf, retain_graph=True)
        assert not by_opacity.any()
        (gradient,) = torch.autograd.grad((rgb * cotangent).sum(), leaf)
        rate = torch.randn(weights.shape, generator=generator, dtype=DOUBLE)
        ahead, behind = (
            (renderer.render_rays(field, rays, weights + h * rate)[0] * cotangent).sum()
            for h in (1e-6, -1e-6)
        )
        assert float((gradient * rate).sum()) == pytest.approx(float(ahead - behind) / 2e-6, rel=1e-6)


def test_wrong_fields_and_weights_are_refused(field: AppearanceField) -> None:
    renderer = NerfWRenderer()
    with pytest.raises(ValueError, match="field=grid_w"):
        renderer.render(GridField().double(), CAMERA, poses())
    with pytest.raises(ValueError, match=r"\(3, 4\)"):
        renderer.render(field, CAMERA, poses(), weights=torch.ones(3, 5))
    with pytest.raises(ValueError, match=r"\(98, 4\)"):
        renderer.render_rays(field, flat(cameras.rays(CAMERA, poses(2))), torch.ones(3, 4))


def test_images_are_those_of_the_plain_renderer(field: AppearanceField) -> None:
    """A field whose code does nothing is a plain grid with the same head."""
    plain = GridField(step_cells=0.5, density_gain=1.0).double()
    plain.reset(torch.ones(12, 12, 12, dtype=torch.bool), torch.full((3,), -1.2, dtype=DOUBLE), 0.2)
    with torch.no_grad():
        plain.table.copy_(field.grid.table[:, :4])
        field.out.weight.zero_(), field.out.bias.zero_()
    expected = NerfRenderer().render(plain.eval(), CAMERA, poses())
    made = NerfWRenderer().render(field, CAMERA, poses())
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-14)


def test_depth_is_along_the_view_axis_to_where_half_of_the_light_is_lost(
    field: AppearanceField, generator: torch.Generator
) -> None:
    """Each pixel's ray is cut at its depth: what is before absorbs half. Weights of lights move no depth."""
    weights, renderer = some_weights(generator, 3), NerfWRenderer(termination=0.0)
    rgb, opacity, depth = renderer.render_surface(field, CAMERA, poses(), weights)
    wanted = renderer.render(field, CAMERA, poses(), weights=weights)
    torch.testing.assert_close((rgb, opacity), wanted, atol=1e-12, rtol=0.0)
    assert torch.equal(depth > 0.0, opacity >= 0.5) and 0.1 < float((depth > 0.0).double().mean()) < 1.0
    bundle = cameras.rays(CAMERA, poses())
    axis = -poses()[:, None, None, :3, 2]
    along = depth / (bundle.directions * axis).sum(-1)
    rays = flat(bundle)
    samples = field.sample(rays, 0.0)
    positions = rays.origins[samples.ray] + rays.directions[samples.ray] * samples.distance[:, None]
    sigma = field.query(positions, rays.directions[samples.ray])[0]
    # Optical depth up to the cut, of the lengths that samples stand for.
    length = (along.flatten()[samples.ray] - samples.distance + 0.5 * samples.width).clamp_min(0.0)
    cut = torch.zeros(len(rays.origins), dtype=DOUBLE)
    cut.index_add_(0, samples.ray, sigma * torch.minimum(length, samples.width))
    seen = (depth > 0.0).flatten()
    torch.testing.assert_close(torch.exp(-cut[seen]), torch.full_like(cut[seen], 0.5), atol=1e-9, rtol=0.0)
