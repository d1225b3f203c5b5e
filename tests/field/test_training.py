"""Fitting from posed views: it learns, the same seed gives the same bits, and bad input is refused."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neural_sim import cameras
from neural_sim.field.fitting import GridFitting, _large_parts
from neural_sim.field.grid import GridField
from neural_sim.field.hull import visual_hull
from neural_sim.field.mlp import MLPField, MLPFitting, inverse_cumulative
from neural_sim.field.recipe import FieldRecipe, field_from_state, field_state, fit_field
from neural_sim.types import PinholeCamera, PosedViews, Rays

RADIUS = 0.6


def ball_views(count: int = 14, size: int = 24) -> PosedViews:
    """An opaque ball of radius 0.6 whose colour is its surface normal, in closed form."""
    generator = torch.Generator().manual_seed(5)
    height, turn = torch.rand(2, count, generator=generator)
    pose = cameras.orbit(torch.arccos(1.0 - 2.0 * height), 2.0 * math.pi * turn, torch.full((count,), 2.8))
    camera = PinholeCamera(size, size, math.radians(40.0))
    bundle = cameras.rays(camera, pose)
    near, far = cameras.unit_sphere_span(bundle, RADIUS)
    normal = (bundle.origins + near[..., None] * bundle.directions) / RADIUS
    hit = (far > near)[..., None].float()
    return PosedViews(torch.cat([(0.5 + 0.5 * normal) * hit, hit], -1), pose, camera)


def fitting(**changes: int) -> GridFitting:
    settings = {"resolution": 64, "prune_rays": 1000, "batch_rays": 512, **changes}
    return GridFitting(GridField(), refine_steps=(25,), **settings)  # pyright: ignore[reportArgumentType]


def test_the_hull_holds_the_object_and_little_more() -> None:
    occupied, origin, cell = visual_hull(ball_views(), 64)
    distance = (origin + (occupied.nonzero() + 0.5) * cell).norm(dim=-1)
    volume = 4.0 / 3.0 * math.pi * RADIUS**3
    grid = torch.stack(torch.meshgrid(*[torch.arange(64)] * 3, indexing="ij"), -1)
    inside = (origin + (grid + 0.5) * cell).norm(dim=-1) < RADIUS
    assert bool(occupied[inside].all())
    assert distance.max() < 1.03 and len(distance) * cell**3 < 3.0 * volume


def test_contradicting_silhouettes_are_refused() -> None:
    views = ball_views()
    with pytest.raises(ValueError, match="share no cell"):
        visual_hull(PosedViews(views.images * 0.0, views.camera_to_world, views.camera), 32)


def test_a_grid_field_learns_the_ball_bit_for_bit_the_same() -> None:
    runs = [
        fit_field(ball_views(), fitting(), torch.Generator().manual_seed(0), steps=60, held_out=2)
        for _ in range(2)
    ]
    (score,) = runs[0][1]
    assert score["step"] == 60 and score["psnr"] > 20.0
    first, second = (field.state_dict() for field, _ in runs)
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("head_width", [0, 4])
def test_a_recipe_gives_the_same_field_whatever_the_process_drew_before(head_width: int) -> None:
    recipe = FieldRecipe(
        lambda: GridField(features=4, head_width=head_width),
        lambda field: GridFitting(field, resolution=32, refine_steps=(), prune_steps=(), batch_rays=256),
        steps=3,
    )
    fits = []
    for _ in range(2):
        torch.rand(7)
        fits.append(recipe.fit(ball_views(), 2, torch.device("cpu"))[0].state_dict())
    assert all(torch.equal(fits[0][name], fits[1][name]) for name in fits[0])


def test_a_network_field_learns_and_survives_saving(tmp_path: Path) -> None:
    views, fits = ball_views(8, 16), []
    for steps in (10, 60):
        field = MLPField(width=32, depth=6, position_frequencies=3, coarse_samples=12, fine_samples=8)
        recipe = MLPFitting(field, batch_rays=128, learning_rate=3e-3)
        fits.append(fit_field(views, recipe, torch.Generator().manual_seed(0), steps=steps, held_out=1))
    (_, (begun,)), (fitted, (score,)) = fits
    assert score["psnr"] > begun["psnr"] + 1.0
    torch.save(field_state(fitted), tmp_path / "field.pt")
    loaded = field_from_state(torch.load(tmp_path / "field.pt", weights_only=True))
    where = torch.rand(20, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(fitted.query(where, where)[1], loaded.query(where, where)[1])


def test_network_samples_are_sorted_repeat_and_cover_the_sphere() -> None:
    field = MLPField(width=16, depth=2, coarse_samples=8, fine_samples=8)
    rays = Rays(torch.tensor([[0.0, 0.0, 3.0], [0.0, 3.0, 3.0]]), torch.tensor([[0.0, 0.0, -1.0]] * 2))
    samples = field.sample(rays, 0.0)
    assert samples.starts.tolist() == [0, 16, 16]
    assert (
        bool((samples.distance.diff() >= 0).all())
        and 2.0 < samples.distance.min() < samples.distance.max() < 4.0
    )
    assert samples.width.sum().item() == pytest.approx(2.0, abs=1e-5)
    assert torch.equal(samples.distance, field.sample(rays, 0.0).distance)


def test_inverse_cumulative_inverts_a_two_step_density() -> None:
    edges = torch.tensor([[0.0, 1.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([[3.0, 1.0]], dtype=torch.float64)
    quantiles = torch.tensor([[0.375, 0.75, 0.875]], dtype=torch.float64)
    assert inverse_cumulative(edges, weights, quantiles)[0].tolist() == pytest.approx([0.5, 1.0, 2.0])


def test_bad_budgets_are_refused() -> None:
    generator = torch.Generator()
    with pytest.raises(ValueError, match="held_out"):
        fit_field(ball_views(3), fitting(), generator, steps=1, held_out=3)
    with pytest.raises(ValueError, match="steps"):
        fit_field(ball_views(3), fitting(), generator, steps=0)


def test_a_fit_that_diverges_is_refused() -> None:
    """Held-out views have no score then, which would read as if there were none of them."""
    with pytest.raises(
        ValueError, match=r"field: the loss is nan after 8 steps: want smaller learning rates"
    ):
        fit_field(ball_views(), fitting(learning_rate=1e38), torch.Generator().manual_seed(0), steps=8)


@pytest.mark.parametrize("photographs", [False, True])
def test_a_fit_that_loses_all_its_cells_is_refused(photographs: bool) -> None:
    views = ball_views()
    known = torch.ones(views.images.shape[:3], dtype=torch.bool) if photographs else None
    with pytest.raises(ValueError, match="no cell is occupied"):
        fit_field(
            replace(views, known=known),
            fitting(learning_rate=1e38),
            torch.Generator().manual_seed(0),
            steps=26,
        )


def test_small_parts_in_the_air_are_left_out():
    """Of three blocks of cells the one with a fiftieth of the largest one's goes, and cells that nothing shows."""
    occupied = torch.zeros(12, 12, 12, dtype=torch.bool)
    occupied[:5, :5, :4] = True  # 100 cells
    occupied[8:10, 8:10, 8:10] = True  # 8
    occupied[11, 0, :2] = True  # 2
    seen = torch.ones(110, dtype=torch.bool)
    seen[0] = False
    kept = torch.zeros_like(occupied)
    kept[occupied] = _large_parts(occupied, seen)
    expected = occupied.clone()
    expected[11, 0, :2] = False
    expected[0, 0, 0] = False
    assert torch.equal(kept, expected)
