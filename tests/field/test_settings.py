"""The field's settings have ranges, and a value out of one is refused by its key."""

from functools import partial

import pytest

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField
from neural_sim.field.recipe import FieldRecipe
from neural_sim.field.scene.recipe import SceneMasks

RECIPE = partial(FieldRecipe, GridField, GridFitting)
GRID = partial(GridFitting, GridField())
CASES = [
    (GridField, {"features": 2}, "GridField.features: want at least 3, got 2"),
    (GridField, {"step_cells": 0.0}, "GridField.step_cells: want more than 0 and at most 2"),
    (GridField, {"head_width": -1}, "GridField.head_width: want at least 0"),
    (AppearanceField, {"head_width": 0}, "AppearanceField.head_width: want at least 1"),
    (AppearanceField, {"features": 2}, "AppearanceField.features: want at least 3"),
    (MLPField, {"fine_samples": 1}, "MLPField.fine_samples: want at least 2"),
    (MLPField, {"density_scale": 0.0}, "MLPField.density_scale: want more than 0"),
    (GRID, {"batch_rays": 0}, "GridFitting.batch_rays: want at least 1"),
    (GRID, {"prune_weight": 1.0}, "GridFitting.prune_weight: want at least 0 and less than 1"),
    (GRID, {"resolution": 100}, "GridFitting.resolution: want a power of two of at least 32, got 100"),
    (GRID, {"resolution": 64}, "GridFitting.resolution: want at least 32 after halving it 2 times, got 64"),
    (GRID, {"refine_steps": (0,)}, "GridFitting.refine_steps[0]: want at least 1"),
    (partial(AppearanceFitting, AppearanceField(), GridFitting), {"anchors": 0}, "AppearanceFitting.anchors: want"),
    (RECIPE, {"steps": 0}, "FieldRecipe.steps: want at least 1"),
    (RECIPE, {"final_rate": 0.0}, "FieldRecipe.final_rate: want more than 0 and at most 1"),
    (SceneMasks, {"resolution": 98}, "SceneMasks.resolution: want at least 16 and a multiple of 4, got 98"),
    (SceneMasks, {"batch_rays": 0}, "SceneMasks.batch_rays: want at least 1"),
    (SceneMasks, {"seed": -1}, "SceneMasks.seed: want at least 0"),
    (SceneMasks, {"steps": 0}, "SceneMasks.steps: want at least 1"),
    (SceneMasks, {"image_size": 15}, "SceneMasks.image_size: want at least 16"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
