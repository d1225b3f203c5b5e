"""What stands in front of the object in single views: the loss by hand, a cleaner object behind painted squares."""

import functools
import math
from collections.abc import Callable

import pytest
import torch

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.fitting import GridFitting
from neural_sim.field.quadrature import PackedSamples
from neural_sim.field.recipe import fit_field
from neural_sim.field.scores import render_lit
from neural_sim.field.transient import SMALLEST_BETA, composite_both, uncertain_error
from neural_sim.types import PosedViews

DOUBLE = torch.float64


def test_two_media_in_one_place_by_hand() -> None:
    """One ray, two samples: transmittance and mixed colours written out."""
    samples = PackedSamples(
        torch.zeros(2, dtype=torch.int64), torch.tensor([1.0, 1.5]), torch.full((2,), 0.5, dtype=DOUBLE),
        torch.tensor([0, 2]),
    )  # fmt: skip
    sigma = torch.tensor([0.4, 2.0], dtype=DOUBLE)
    passing = torch.tensor([1.2, 0.0], dtype=DOUBLE)
    rgb, theirs = (
        torch.tensor([[0.2, 0.4, 0.6], [0.9, 0.8, 0.7]], dtype=DOUBLE),
        torch.ones(2, 3, dtype=DOUBLE),
    )
    beta = torch.tensor([0.5, 9.0], dtype=DOUBLE)
    (colour, opacity), found = composite_both((sigma, rgb), (passing, theirs, beta), samples)
    first, second = 1 - math.exp(-0.8), math.exp(-0.8) * (1 - math.exp(-1.0))
    mixed = 0.25 * rgb[0] + 0.75 * theirs[0]
    torch.testing.assert_close(colour[0], first * mixed + second * rgb[1])
    assert opacity.item() == pytest.approx(1 - math.exp(-1.8))
    assert found.item() == pytest.approx(SMALLEST_BETA + first * 0.75 * 0.5)


def test_the_loss_by_hand() -> None:
    """Equal opacities: the expected square error is that of colour, three channels added."""
    pixels = torch.tensor([[0.1, 0.2, 0.3, 1.0], [0.5, 0.5, 0.5, 1.0]], dtype=DOUBLE)
    rendering = (torch.tensor([[0.2, 0.2, 0.1], [0.5, 0.5, 0.5]], dtype=DOUBLE), torch.ones(2, dtype=DOUBLE))
    beta, depths = torch.tensor([0.1, 0.5], dtype=DOUBLE), torch.tensor([0.3, 0.5, 0.1], dtype=DOUBLE)
    by_hand = 0.5 * (0.05 / (2 * 0.01) + math.log(0.1) + math.log(0.5)) + 0.02 * 0.3
    assert uncertain_error(rendering, pixels, beta, depths, 0.02).item() == pytest.approx(by_hand)


def with_occluders(views: PosedViews, share: float) -> PosedViews:
    """A bright square at a place and of a colour of its own over ``share`` of the views; alpha as before."""
    generator, images = torch.Generator().manual_seed(3), views.images.clone()
    for i in range(round(share * len(views))):
        row, column = (int(x) for x in torch.randint(9, 15, (2,), generator=generator))
        images[i, row : row + 9, column : column + 9, :3] = torch.rand(3, generator=generator)
    return PosedViews(images, views.camera_to_world, views.camera, views.light_weights)


@pytest.mark.slow
def test_the_object_is_cleaner_with_transients_than_without(
    lit_ball: Callable[..., PosedViews], colour_error: Callable[[torch.Tensor, torch.Tensor], float]
) -> None:
    views, errors = with_occluders(lit_ball(30, 5), 0.3), {}
    grid = functools.partial(
        GridFitting, resolution=32, refine_steps=(), prune_steps=(75,), prune_rays=1000, batch_rays=1024
    )
    for transients in (False, True):
        torch.manual_seed(0)
        fitting = AppearanceFitting(AppearanceField(head_width=16, code_size=8), grid, transients=transients)
        field, _ = fit_field(views, fitting, torch.Generator().manual_seed(0), steps=240)
        assert isinstance(field, AppearanceField)
        clean = lit_ball(9, 13)
        assert clean.light_weights is not None
        rendered = render_lit(field, clean.light_weights @ field.anchors, clean, 1e-3, 4096)
        errors[transients] = colour_error(rendered, clean.images)
        assert "transient" not in " ".join(field.state_dict())
    assert errors[True] < 0.7 * errors[False]
