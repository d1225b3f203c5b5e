"""Fitting under varied light: it learns each light, mixtures of lights, and lights that nobody knows."""

import functools
import math
from collections.abc import Callable

import pytest
import torch

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.fitting import GridFitting
from neural_sim.field.recipe import fit_field
from neural_sim.field.scores import fit_codes, render_lit, right_half
from neural_sim.types import PosedViews

LitBall = Callable[..., PosedViews]
ColourError = Callable[[torch.Tensor, torch.Tensor], float]
GRID = functools.partial(
    GridFitting, resolution=32, refine_steps=(), prune_steps=(25,), prune_rays=1000, batch_rays=1024
)


def fitted(views: PosedViews, steps: int = 150, held_out: int = 0, **settings: object):
    torch.manual_seed(0)  # the head's linear layers
    fitting = AppearanceFitting(AppearanceField(head_width=16, code_size=8), GRID, **settings)  # pyright: ignore
    return fit_field(views, fitting, torch.Generator().manual_seed(0), steps=steps, held_out=held_out)


@pytest.fixture(scope="module")
def shared(lit_ball: LitBall) -> AppearanceField:
    field, _ = fitted(lit_ball(30, 5))
    assert isinstance(field, AppearanceField)
    return field


def test_it_learns_every_light_and_their_mixtures(
    shared: AppearanceField, lit_ball: LitBall, colour_error: ColourError
) -> None:
    """Far better than a field without codes could at best, which is to show the mean of the lights exactly."""
    weights = torch.cat([torch.eye(3), torch.tensor([[0.5, 0.5, 0.0], [0.2, 0.3, 0.5], [0.1, 0.8, 0.1]])])
    truth, mean_light = lit_ball(6, 11, weights), lit_ball(6, 11, weights.mean(0).expand(6, -1))
    assert shared.codes.shape == (3, 8) and torch.equal(shared.anchors, shared.codes)
    lit = render_lit(shared, weights @ shared.anchors, truth, 1e-3, 4096)
    assert colour_error(lit, truth.images) < 0.4 * colour_error(mean_light.images, truth.images)


def test_codes_are_found_for_views_of_unknown_light(
    shared: AppearanceField, lit_ball: LitBall, colour_error: ColourError
) -> None:
    """Fitted to left halves they show these as well as the known light does, and right halves better than no code.

    A light from the right leaves little trace on the left, so the known light remains better there.
    """
    weights = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5]]
    )
    views = lit_ball(5, 12, weights)
    codes = {
        "known": weights @ shared.anchors,
        "found": fit_codes(shared, views, 1e-3),
        "none": shared.anchors.mean(0).expand(5, -1),
    }
    left, right = {}, {}
    for name, code in codes.items():
        rendered = render_lit(shared, code, views, 1e-3, 4096)
        left[name] = colour_error(rendered[:, :, :16], views.images[:, :, :16])
        right[name] = colour_error(right_half(rendered), right_half(views.images))
    assert left["found"] < 1.1 * left["known"] and left["found"] < 0.5 * left["none"]
    assert right["found"] < 0.8 * right["none"]


def test_photographs_learn_a_code_each_and_give_their_anchors(lit_ball: LitBall) -> None:
    views = lit_ball(16, 5)
    views = PosedViews(views.images, views.camera_to_world, views.camera)
    field, history = fitted(views, steps=60, held_out=2, anchors=4)
    assert isinstance(field, AppearanceField)
    assert field.codes.shape == (14, 8) and field.anchors.shape == (4, 8)
    assert torch.equal(field.anchors, field.codes[[0, 4, 8, 13]])
    assert math.isfinite(history[-1]["psnr"])


def test_the_same_seed_gives_the_same_bits(lit_ball: LitBall) -> None:
    views = lit_ball(12, 5)
    first, second = (fitted(views, steps=20)[0].state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_more_anchors_than_views_are_refused(lit_ball: LitBall) -> None:
    views = lit_ball(4, 5)
    with pytest.raises(ValueError, match="anchors: want at most 4, the number of views, got 6"):
        fitted(PosedViews(views.images, views.camera_to_world, views.camera))
