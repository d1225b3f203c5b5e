"""A table's values at the vertices of a finer grid."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.interpolation import CORNERS, corner_weights, gather_weighted
from neural_sim.field.marching import lookup
from neural_sim.field.occupancy import Occupancy


def interpolate_from(
    local: Float[Tensor, "vertices 3"], occupancy: Occupancy, corners: Tensor, table: Tensor
) -> Float[Tensor, "vertices channels"]:
    """Values of an old table at grid vertices, each from whichever of its eight neighbouring cells is occupied."""
    result = table.new_zeros(len(local), table.shape[1])
    missing = torch.arange(len(local), device=local.device)
    for corner in CORNERS:
        nudge = (corner.to(local) - 0.5) * 1e-2
        here = local.index_select(0, missing)
        cell = lookup(here + nudge, occupancy)
        hit = (cell >= 0).nonzero()[:, 0]
        base = (here + nudge).floor().index_select(0, hit)
        weights = corner_weights(*(here.index_select(0, hit) - base).t().contiguous())
        rows = corners.index_select(0, cell.index_select(0, hit))
        result.index_copy_(0, missing.index_select(0, hit), gather_weighted(table, rows, weights))
        missing = missing[cell < 0]
    return result
