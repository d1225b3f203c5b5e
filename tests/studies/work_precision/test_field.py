"""Fits by steps: schedules move with the steps, and errors are those of the fields' scores."""

from dataclasses import replace
from functools import partial

import pytest

from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.recipe import FieldRecipe
from neural_sim.studies.work_precision.field import Fields, scaled
from neural_sim.studies.work_precision.measurement import Timing

RECIPE = FieldRecipe(
    partial(GridField),
    partial(GridFitting, resolution=64, refine_steps=[8], prune_steps=[12], batch_rays=256),
    16,
)


def test_schedules_move_with_the_steps():
    twice = scaled(RECIPE, 2.0)
    assert twice.steps == 32
    assert twice.fitting.keywords == {
        "resolution": 64, "refine_steps": [16], "prune_steps": [24], "batch_rays": 256
    }  # fmt: skip
    assert scaled(RECIPE, 0.01).steps == 1 and scaled(RECIPE, 1.0).fitting.keywords == RECIPE.fitting.keywords


def test_errors_are_those_of_the_fits(small_world):
    plain = partial(GridFitting, resolution=32, refine_steps=[], prune_steps=[], batch_rays=256)
    recipe = replace(RECIPE, fitting=plain)
    family = Fields({"grid": recipe}, {"grid": (0.25, 1.0)})
    (series,) = family.measure(small_world, Timing(1), 0)
    few, all_steps = series.points
    assert (few.setting, all_steps.setting) == ("grid, 4 steps", "grid, 16 steps")
    assert (few.default, all_steps.default) == (False, True) and series.clock == "seconds"
    history = recipe.fit(small_world.views, small_world.held_out, small_world.views.images.device)[1]
    assert all_steps.error == pytest.approx(10.0 ** (-history[-1]["psnr"] / 20.0), rel=1e-9)


def test_bad_settings_name_their_key():
    for wrong in ({"parts": {"mlp": (1.0,)}}, {"parts": {"grid": (0.0,)}}, {"default": "mlp"}):
        with pytest.raises(ValueError, match=r"work_precision\.field|Fields\.parts\.grid"):
            Fields(**{"recipes": {"grid": RECIPE}, "parts": {"grid": (1.0,)}, **wrong})
