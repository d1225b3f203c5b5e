"""The fused render against the samples' own way, and what is left out of it: nothing that changes a pixel."""

import itertools
import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.cameras import pixel_rays
from neural_sim.field.base import RadianceField
from neural_sim.field.extinction import Surface
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField
from neural_sim.field.pixels import seen_pixels
from neural_sim.field.quadrature import sample_points
from neural_sim.field.rendering import render_packed, render_views
from neural_sim.field.screen import coarse_centres, screen_span
from neural_sim.types import PinholeCamera, Rays

DOUBLE = torch.float64
CAMERA = PinholeCamera(24, 18, math.radians(40.0))
OFF_CENTRE = cameras.opencv_camera(30, 20, 40.0, 25.0, 3.0, 15.0)


def shell(generator: torch.Generator, head_width: int = 0, dtype: torch.dtype = DOUBLE) -> GridField:
    """A rough hollow ball: occupied cells and empty ones mixed, inside and out."""
    field = GridField(features=4 if head_width else 3, head_width=head_width, density_gain=1.0).to(dtype)
    grid = torch.stack(torch.meshgrid(*[torch.arange(20)] * 3, indexing="ij"), -1)
    distance = (grid - 9.5).norm(dim=-1)
    occupied = (distance > 5.0) & (distance < 8.0) & (torch.rand(20, 20, 20, generator=generator) < 0.6)
    field.reset(occupied, torch.full((3,), -1.0, dtype=dtype), 0.1)
    with torch.no_grad():
        rows = torch.randn(field.table[:-1].shape, generator=generator, dtype=DOUBLE)
        field.table[:-1] = rows.to(dtype)
    return field.eval().requires_grad_(False)


def poses(dtype: torch.dtype = DOUBLE) -> torch.Tensor:
    angles = torch.tensor([0.3, 1.9, 4.0], dtype=dtype)
    return cameras.orbit(angles, angles * 0.5, torch.tensor([2.4, 3.0, 4.0], dtype=dtype))


def bundle(dtype: torch.dtype = DOUBLE) -> Rays:
    pixels = torch.arange(3 * CAMERA.width * CAMERA.height)
    return pixel_rays(CAMERA, poses(dtype), pixels)


@pytest.mark.parametrize("head_width", [0, 5])
@pytest.mark.parametrize("termination", [0.0, 1e-3, 0.1])
def test_the_fused_render_equals_the_query_of_its_samples(
    head_width: int, termination: float, generator: torch.Generator
) -> None:
    field = shell(generator, head_width)
    rgb, opacity = field.trace(bundle(), termination)
    torch.testing.assert_close(
        (rgb, opacity), render_packed(field, bundle(), termination), atol=1e-12, rtol=0.0
    )
    assert 0.5 < float(opacity.max()) <= 1.0 and float(opacity.min()) == 0.0


def test_the_fused_render_keeps_the_digits_of_single_precision(generator: torch.Generator) -> None:
    field = shell(generator, dtype=torch.float32)
    traced, queried = (
        torch.cat([rgb, opacity[:, None]], -1)
        for rgb, opacity in (
            field.trace(bundle(torch.float32), 0.0),
            render_packed(field, bundle(torch.float32), 0.0),
        )
    )
    # A sample on the border of an empty cell may fall to either side of it by rounding; no other differs.
    difference = (traced - queried).abs().amax(-1)
    assert float(difference.sort().values[:-3].max()) < 1e-5


@pytest.mark.parametrize("camera", [CAMERA, OFF_CENTRE], ids=["centred", "off centre"])
@pytest.mark.parametrize("chunk", [50, 400, 65536])
@pytest.mark.parametrize("termination", [0.0, 1e-2])
def test_no_pixel_changes_where_pixels_or_empty_space_are_left_out(
    camera: PinholeCamera, chunk: int, termination: float, generator: torch.Generator
) -> None:
    field = shell(generator)
    every = render_views(field, camera, poses(), termination, chunk, cull=False, skip_empty=False)
    for cull, skip_empty in ((True, False), (False, True), (True, True)):
        some = render_views(field, camera, poses(), termination, chunk, cull, skip_empty)
        torch.testing.assert_close(some, every, atol=1e-12, rtol=0.0)


@pytest.mark.parametrize("distance", [2.4, 6.0])
def test_an_off_centre_camera_casts_fewer_rays(distance: float, generator: torch.Generator) -> None:
    """As seen from far away, the object is at the principal point, in the image's lower left."""
    field, camera = shell(generator), cameras.opencv_camera(60, 40, 80.0, 50.0, 6.0, 30.0)
    pose = cameras.orbit(*torch.tensor([[0.8], [0.2], [distance]], dtype=DOUBLE))
    every = render_views(field, camera, pose, 0.0, 1000, cull=False)
    torch.testing.assert_close(render_views(field, camera, pose, 0.0, 1000), every, atol=1e-12, rtol=0.0)
    opacity = every[0, ..., 3]
    at = (
        (opacity.sum(0) * torch.arange(60)).sum() / opacity.sum(),
        (opacity.sum(1) * torch.arange(40)).sum() / opacity.sum(),
    )
    assert float(at[0]) < 20 and float(at[1]) > 24
    cast = sum(len(seen.pixel) for seen in seen_pixels(field, camera, pose, 1000))
    assert distance < 5 or cast < 0.5 * 60 * 40


def test_blocks_of_a_large_image_miss_no_pixel(generator: torch.Generator) -> None:
    """An occupied coarse cell covers some fifty pixels across here: pixels are looked at in blocks of six."""
    field, large, pose = shell(generator), PinholeCamera(241, 180, math.radians(40.0)), poses()[:1]
    pose[:, :3, 3] *= 2.0
    every = render_views(field, large, pose, 0.0, 3000, cull=False)
    torch.testing.assert_close(render_views(field, large, pose, 0.0, 3000), every, atol=1e-12, rtol=0.0)
    assert sum(len(seen.pixel) for seen in seen_pixels(field, large, pose, 3000)) < 0.8 * 241 * 180


def test_culling_leaves_out_pixels_and_bounds_every_sample(generator: torch.Generator) -> None:
    field, far_away = shell(generator), poses()
    far_away[:, :3, 3] *= 2.0
    cast = 0
    for seen in seen_pixels(field, CAMERA, far_away, 200):
        assert seen.span is not None and 0 < len(seen.pixel) <= 200
        cast += len(seen.pixel)
        samples = field.sample(pixel_rays(CAMERA, far_away, seen.pixel), 0.0)
        assert bool((samples.distance >= seen.span.near[samples.ray]).all())
        assert bool((samples.distance <= seen.span.far[samples.ray]).all())
    assert cast < 0.6 * 3 * CAMERA.width * CAMERA.height


@pytest.mark.parametrize("distance", [0.0, 0.9, 1.2, 8.0])
def test_a_camera_anywhere_sees_what_it_saw(distance: float, generator: torch.Generator) -> None:
    """In the middle, among the cells, close by with cells beside and behind the camera, and far away."""
    field = shell(generator)
    pose = cameras.orbit(*torch.tensor([[0.8], [0.2], [distance]], dtype=DOUBLE))
    every = render_views(field, CAMERA, pose, 0.0, 1000, cull=False)
    assert float(every[..., 3].max()) > 0.2
    torch.testing.assert_close(render_views(field, CAMERA, pose, 0.0, 1000), every, atol=1e-12, rtol=0.0)


def test_strips_know_as_much_as_the_whole_image(generator: torch.Generator) -> None:
    centres, radius = coarse_centres(shell(generator).occupancy)
    whole = screen_span(centres, radius, CAMERA, poses()[1], range(CAMERA.height))
    strips = [
        screen_span(centres, radius, CAMERA, poses()[1], range(top, top + 6))
        for top in range(0, CAMERA.height, 6)
    ]
    inside = whole.near <= whole.far
    near, far = (torch.cat([getattr(strip, name) for strip in strips]) for name in ("near", "far"))
    assert torch.equal(near[inside], whole.near[inside]) and torch.equal(far[inside], whole.far[inside])


def test_a_longer_step_takes_fewer_samples_of_the_same_field(generator: torch.Generator) -> None:
    field = shell(generator)
    coarse = field.with_step(2.0)
    assert coarse.step == 2.0 * field.step and coarse.table is field.table and field.step_cells == 1.0
    assert len(coarse.sample(bundle(), 0.0)) < 0.6 * len(field.sample(bundle(), 0.0))
    network = MLPField(width=8, depth=2, coarse_samples=8, fine_samples=6)
    assert int(network.with_step(2.0).sample(bundle(torch.float32), 0.0).starts.diff().max()) == 7
    assert field.with_step(1.0) is field and network.with_step(1.0) is network


@pytest.mark.parametrize("multiple", [1.0, 0.3])
def test_a_surface_is_where_half_of_the_light_is_lost(multiple: float, generator: torch.Generator) -> None:
    """Against each ray's samples one by one: optical depth grows linearly over the length that a sample stands for."""
    field = shell(generator).with_step(multiple)
    samples = field.sample(bundle(), 0.0)
    sigma = field.query(*sample_points(bundle(), samples))[0].tolist()
    wanted, starts = [], samples.starts.tolist()
    for first, last in itertools.pairwise(starts):
        depth, found = 0.0, 0.0
        for i in range(first, last):
            width = float(samples.width[i])
            if depth < math.log(2.0) <= depth + sigma[i] * width:
                near = float(samples.distance[i]) - 0.5 * width
                found = near + (math.log(2.0) - depth) / sigma[i]
            depth += sigma[i] * width
        wanted.append(found)
    assert 0.1 < sum(at > 0.0 for at in wanted) / len(wanted) < 0.9
    fused, plain = (Surface(len(wanted), field.table) for _ in range(2))
    opacity = field.trace(bundle(), 1e-3, surface=fused)[1]
    RadianceField.trace(field, bundle(), 0.0, surface=plain)
    for surface in (fused, plain):
        torch.testing.assert_close(surface.distance, torch.tensor(wanted, dtype=DOUBLE), atol=1e-10, rtol=0.0)
    assert torch.equal(fused.distance > 0.0, opacity >= 0.5)


def test_no_density_lies_beyond_the_reach(generator: torch.Generator) -> None:
    field = shell(generator)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    cells = field.occupied.nonzero()[:, None] + corners
    farthest = float((field.origin + cells.to(DOUBLE) * field.edge).norm(dim=-1).max())
    assert farthest <= field.reach
    assert MLPField(width=8, depth=2, coarse_samples=4, fine_samples=4).reach == 1.0
