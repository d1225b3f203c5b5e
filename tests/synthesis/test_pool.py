"""The size of a pool: the fewest renders of each combination of bins that give every bin its number."""

import math

import pytest

from neural_sim.parameter.factor import BinnedFactor
from neural_sim.synthesis.pool import pool_cells


@pytest.mark.parametrize("per_bin", [1, 4, 5, 7])
@pytest.mark.parametrize("bins", [(4,), (3, 2), (2, 5), (4, 2, 3)])
def test_every_bin_has_at_least_the_renders_that_are_asked_for_and_no_more_than_it_takes(bins, per_bin):
    coordinates = ("phi", "rho", "distance")
    factors = [BinnedFactor(c, c, count, 1.0, 2.0) for c, count in zip(coordinates, bins, strict=False)]
    cells, per_cell = pool_cells(factors, per_bin)
    assert cells == math.prod(bins)
    scarcest = min(cells // count for count in bins)  # combinations that hold a bin of the finest factor
    assert scarcest * per_cell >= per_bin > scarcest * (per_cell - 1)
    assert pool_cells([], per_bin) == (1, per_bin)
