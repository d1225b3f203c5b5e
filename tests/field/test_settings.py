"""Ranges of the field's settings across several of them, and of classes that conf/ does not make."""

from functools import partial

import pytest

from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.scene.recipe import SceneMasks

GRID = partial(GridFitting, GridField())
CASES = [
    (GRID, {"resolution": 100}, "GridFitting.resolution: want a power of two of at least 32, got 100"),
    (GRID, {"resolution": 64}, "GridFitting.resolution: want at least 32 after halving it 2 times, got 64"),
    (SceneMasks, {"resolution": 98}, "SceneMasks.resolution: want at least 16 and a multiple of 4, got 98"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)
