"""The field renderer: whole views against rays, and derivatives with respect to rays in both modes."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.field.grid import GridField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera, Rays


@pytest.fixture
def field(generator: torch.Generator) -> GridField:
    """A soft ball: smooth densities and colours, zero density at the border of the occupied cells."""
    field = GridField(step_cells=0.5, density_gain=1.0).double()
    field.reset(torch.ones(12, 12, 12, dtype=torch.bool), torch.full((3,), -1.2, dtype=torch.float64), 0.2)
    grid = torch.stack(
        torch.meshgrid(*[torch.linspace(-1.2, 1.2, 13, dtype=torch.float64)] * 3, indexing="ij"), -1
    )
    with torch.no_grad():
        field.table[:-1, 0] = (6.0 - 12.0 * grid.flatten(0, 2).norm(dim=-1)).clamp_min(-40.0)
        field.table[:-1, 1:] = torch.randn(13**3, 3, generator=generator, dtype=torch.float64)
    return field.eval().requires_grad_(False)


def view(size: int = 9) -> tuple[PinholeCamera, torch.Tensor]:
    angles = torch.tensor([0.3, 1.9], dtype=torch.float64)
    return PinholeCamera(size, size, math.radians(40.0)), cameras.orbit(angles, angles * 0.5, angles + 2.5)


def flat(bundle: Rays) -> Rays:
    return Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))


def test_views_equal_their_rays_whatever_the_chunk(field: GridField) -> None:
    camera, poses = view()
    renderer = NerfRenderer(rays_per_chunk=50)
    rgb, opacity = renderer.render(field, camera, poses)
    ray_rgb, ray_opacity = renderer.render_rays(field, flat(cameras.rays(camera, poses)))
    torch.testing.assert_close(rgb.reshape(-1, 3), ray_rgb, atol=1e-12, rtol=0.0)
    torch.testing.assert_close(opacity.flatten(), ray_opacity, atol=1e-12, rtol=0.0)
    assert 0.2 < opacity.max() <= 1.0 and opacity.min() == 0.0


def test_early_termination_errs_by_less_than_its_transmittance(field: GridField) -> None:
    camera, poses = view()
    full, _ = NerfRenderer().render(field, camera, poses, exact=True)
    short, _ = NerfRenderer(termination=1e-2).render(field, camera, poses)
    assert 0.0 < (full - short).abs().max() < 1e-2


def test_rays_that_miss_are_black_and_transparent(field: GridField) -> None:
    rays = Rays(torch.full((3, 3), 5.0, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    rgb, opacity = NerfRenderer().render_rays(field, rays)
    assert not rgb.any() and not opacity.any()


def test_derivatives_equal_central_differences_in_the_rays(
    field: GridField, generator: torch.Generator
) -> None:
    camera, poses = view(5)
    bundle = flat(cameras.rays(camera, poses[:1]))
    origins, directions = bundle.origins.clone().requires_grad_(), bundle.directions.clone().requires_grad_()
    renderer = NerfRenderer(termination=0.0)
    cotangent = torch.randn(25, 4, generator=generator, dtype=torch.float64)

    def value(o: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        rgb, opacity = renderer.render_rays(field, Rays(o, d))
        return (torch.cat([rgb, opacity[:, None]], -1) * cotangent).sum()

    gradient = torch.autograd.grad(value(origins, directions), (origins, directions))
    for _ in range(3):
        along = tuple(torch.randn(25, 3, generator=generator, dtype=torch.float64) for _ in range(2))
        slope = sum(float((g * t).sum()) for g, t in zip(gradient, along, strict=True))
        step = 1e-6
        with torch.no_grad():
            ahead = value(origins + step * along[0], directions + step * along[1])
            behind = value(origins - step * along[0], directions - step * along[1])
        assert slope == pytest.approx(float(ahead - behind) / (2.0 * step), rel=1e-5, abs=1e-6)


def test_forward_mode_equals_reverse_mode_through_the_pose(field: GridField) -> None:
    camera, _ = view(7)
    renderer = NerfRenderer()
    pose = torch.tensor([0.7, 0.2, 3.0], dtype=torch.float64)
    tangent = torch.tensor([0.4, -1.0, 0.3], dtype=torch.float64)

    def image(v: torch.Tensor) -> torch.Tensor:
        bundle = flat(cameras.rays(camera, cameras.orbit(v[0], v[1], v[2])))
        rgb, opacity = renderer.render_rays(field, bundle)
        return torch.cat([rgb, opacity[:, None]], -1)

    _, forward = torch.func.jvp(image, (pose,), (tangent,))
    reverse = torch.autograd.functional.jacobian(image, pose) @ tangent
    assert float(reverse.abs().max()) > 0.1
    torch.testing.assert_close(forward, reverse, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("rays_per_chunk", [20, 100, 10_000])
def test_tangents_ride_along_with_the_render(field: GridField, rays_per_chunk: int) -> None:
    """Against central differences of whole views as the camera turns, and as it goes away."""
    camera, poses = view(7)
    renderer = NerfRenderer(termination=0.0, rays_per_chunk=rays_per_chunk)
    phi, ones = torch.tensor([0.3, 1.9], dtype=torch.float64), torch.ones(2, dtype=torch.float64)

    def turned(angle: torch.Tensor) -> torch.Tensor:
        return cameras.orbit(angle, 0.5 * phi, phi + 2.5)

    def zoomed(distance: torch.Tensor) -> torch.Tensor:
        return cameras.orbit(phi, 0.5 * phi, distance)

    moves = [(turned, phi), (zoomed, phi + 2.5)]
    rates = torch.stack([torch.func.jvp(move, (number,), (ones,))[1] for move, number in moves])
    maps, tangents = renderer.render_with_tangents(field, camera, poses, rates)
    rgb, opacity = renderer.render(field, camera, poses)
    torch.testing.assert_close((maps.rgb, maps.opacity), (rgb, opacity), rtol=0.0, atol=1e-12)
    for (move, number), tangent in zip(moves, tangents, strict=True):
        ahead, behind = (renderer.render(field, camera, move(number + step)) for step in (1e-6, -1e-6))
        slopes = tuple((a - b) / 2e-6 for a, b in zip(ahead, behind, strict=True))
        torch.testing.assert_close((tangent.rgb, tangent.opacity), slopes, rtol=1e-4, atol=1e-5)
        assert float(tangent.rgb.abs().max()) > 0.1


def test_wrong_shapes_and_settings_are_refused(field: GridField) -> None:
    with pytest.raises(ValueError, match=r"\(rays, 3\)"):
        NerfRenderer().render_rays(field, Rays(torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)))
    with pytest.raises(ValueError, match="termination"):
        NerfRenderer(termination=1.0)
    with pytest.raises(ValueError, match="rays_per_chunk"):
        NerfRenderer(rays_per_chunk=0)
