"""A field whose process was killed goes on after its last checkpoint, to the same bits."""

import functools

import pytest
import torch

from neural_sim.checkpoint import Checkpoint
from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.mlp import MLPField, MLPFitting
from neural_sim.field.recipe import FieldRecipe
from neural_sim.stages.store import Store

STEPS, KILLED = 40, (22, 3, 31)
GRID = functools.partial(
    GridFitting, resolution=64, refine_steps=(13,), prune_steps=(27,), prune_rays=500, batch_rays=200
)
RECIPES = {
    "grid": FieldRecipe(lambda: GridField(features=4, head_width=4), GRID, STEPS),
    "appearance": FieldRecipe(
        lambda: AppearanceField(head_width=8, code_size=4),
        lambda field: AppearanceFitting(field, GRID),
        STEPS,
    ),
    "mlp": FieldRecipe(
        lambda: MLPField(width=16, depth=2, coarse_samples=8, fine_samples=4),
        lambda field: MLPFitting(field, batch_rays=64),
        STEPS,
    ),
}


class Killed(Exception):
    """What ends a fit here."""


def _fit(recipe, views, checkpoint=None, killed_at=None):
    """Fit, up to a step at most; return the tensors, the scores and the number of steps."""
    taken = 0

    def fitting(field):
        made = recipe.fitting(field)
        loss = made.loss

        def counted():
            nonlocal taken
            if taken == killed_at:
                raise Killed
            taken += 1
            return loss()

        made.loss = counted
        return made

    counting = FieldRecipe(recipe.field, fitting, recipe.steps)
    field, history = counting.fit(views, 2, torch.device("cpu"), checkpoint)
    scores = [{key: value for key, value in row.items() if key != "seconds"} for row in history]
    return {name: tensor.tolist() for name, tensor in field.state_dict().items()}, scores, taken


@pytest.mark.parametrize("kind", RECIPES)
def test_a_killed_fit_ends_at_the_same_bits(kind, lit_ball, tmp_path):
    store, recipe, views = Store(tmp_path), RECIPES[kind], lit_ball(9, 5, size=24)
    (tmp_path / "field").mkdir()
    whole = _fit(recipe, views)
    assert whole[2] == STEPS

    def checkpoint():
        return Checkpoint(
            lambda: store.state("field", "a"), lambda state: store.keep("field", "a", state), every=0.0
        )

    reached = 0
    for steps in KILLED:
        if reached + steps >= STEPS:
            break
        with pytest.raises(Killed):
            _fit(recipe, views, checkpoint(), steps)
        reached = checkpoint().read()["step"]
    assert 0 < reached < STEPS
    tensors, scores, taken = _fit(recipe, views, checkpoint())
    assert (tensors, scores) == whole[:2]
    assert taken == STEPS - reached
