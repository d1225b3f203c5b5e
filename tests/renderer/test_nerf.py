"""The field renderer: whole views against rays, and derivatives with respect to rays in both modes."""

import math

import pytest
import torch
from made_fields import soft_ball
from torch.nn.functional import normalize

from neural_sim import cameras
from neural_sim.field.grid import GridField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import PinholeCamera, Rays


@pytest.fixture
def field(generator: torch.Generator) -> GridField:
    return soft_ball(generator)


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


@pytest.fixture(scope="module")
def cup() -> GridField:
    """A thin opaque cup with a painted side, as fits leave it: dense within two cells of its surface.

    (A wall thinner than a step of two cells shows through: one cell thick, this cup errs by 0.12.)
    """
    field, cell = GridField(), 1.0 / 24.0
    field.reset(torch.ones(48, 48, 48, dtype=torch.bool), torch.full((3,), -1.0), cell)
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-1.0, 1.0, 49)] * 3, indexing="ij"), -1).flatten(0, 2)
    radius, height = grid[:, :2].norm(dim=-1), grid[:, 2]
    wall = torch.maximum((radius - 0.5).abs(), height.abs() - 0.6)
    floor = torch.maximum((height + 0.6).abs(), radius - 0.5)
    with torch.no_grad():
        field.table[:-1, 0] = 16.0 - 8.0 * torch.minimum(wall, floor) / cell
        field.table[:-1, 1:] = 2.0 * torch.sin(4.0 * grid)
    field.keep(field.table[:-1, 0].detach().view(49, 49, 49)[:-1, :-1, :-1].flatten() > -12.0, refine=False)
    return field.eval().requires_grad_(False)


@pytest.mark.parametrize(
    ("termination", "step", "opacity_error", "colour_psnr"),
    [(1e-2, 2.0, 0.02, 30.0), (1e-2, 1.0, 0.01, 45.0), (1e-3, 1.0, 0.001, 65.0)],
)
def test_omissions_stay_within_their_errors(
    cup: GridField, termination: float, step: float, opacity_error: float, colour_psnr: float
) -> None:
    camera, poses = PinholeCamera(64, 64, math.radians(40.0)), view()[1].float()
    renderer = NerfRenderer(termination=termination, step=step)
    rgb, opacity = renderer.render(cup, camera, poses)
    every_rgb, every_opacity = renderer.render(cup, camera, poses, exact=True)
    shown = (opacity > 0.01) | (every_opacity > 0.01)
    assert int(shown.sum()) > 500 and float(every_opacity.max()) > 0.99
    assert 0.0 < float((opacity - every_opacity).abs()[shown].mean()) < opacity_error
    assert float((rgb - every_rgb).square().mean()) < 10.0 ** (-colour_psnr / 10.0)


@pytest.mark.parametrize(("termination", "step"), [(1e-2, 2.0), (1e-2, 1.0), (1e-3, 1.0)])
def test_values_and_derivatives_are_those_of_one_function(
    field: GridField, termination: float, step: float, generator: torch.Generator
) -> None:
    """Views, replayed rays, tangents and reverse mode agree, whatever is left out."""
    camera, poses = view(7)
    renderer = NerfRenderer(termination=termination, step=step)
    rates = torch.randn(9, 2, 4, 4, generator=generator, dtype=torch.float64)
    maps, tangents = renderer.render_with_tangents(field, camera, poses, rates)
    torch.testing.assert_close(
        (maps.rgb, maps.opacity), renderer.render(field, camera, poses), rtol=0.0, atol=1e-12
    )

    def replayed(pose: torch.Tensor) -> torch.Tensor:
        rays = flat(cameras.rays(camera, pose))
        # Rates of any matrix, under which directions would not stay of unit length by themselves.
        rgb, opacity = renderer.render_rays(field, Rays(rays.origins, normalize(rays.directions, dim=-1)))
        return torch.cat([rgb, opacity[:, None]], -1)

    first = replayed(poses)
    assert torch.equal(first, replayed(poses))
    # Nine rates are more than a ray has numbers; two are fewer.
    few = renderer.render_with_tangents(field, camera, poses, rates[:2])[1]
    for number, tangent in enumerate(tangents):
        _, expected = torch.func.jvp(replayed, (poses,), (rates[number],))
        stacked = torch.cat([tangent.rgb, tangent.opacity[..., None]], -1).view(-1, 4)
        torch.testing.assert_close(stacked, expected, rtol=1e-9, atol=1e-10)
        if number < len(few):
            torch.testing.assert_close((few[number].rgb, few[number].opacity), (tangent.rgb, tangent.opacity))
    cotangent = torch.randn(first.shape, generator=generator, dtype=torch.float64)
    leaf = poses.clone().requires_grad_()
    (pulled,) = torch.autograd.grad(replayed(leaf), leaf, cotangent)
    along = torch.cat([tangents[0].rgb, tangents[0].opacity[..., None]], -1).view(-1, 4)
    assert float((along * cotangent).sum()) == pytest.approx(float((pulled * rates[0]).sum()), rel=1e-9)


def test_wrong_shapes_are_refused(field: GridField) -> None:
    with pytest.raises(ValueError, match=r"\(rays, 3\)"):
        NerfRenderer().render_rays(field, Rays(torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)))
