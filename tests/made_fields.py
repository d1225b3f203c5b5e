"""Fields that tests of renderers share."""

import torch

from neural_sim.field.grid import GridField


def soft_ball(generator: torch.Generator) -> GridField:
    """A field with smooth densities and colours, zero density at the border of the occupied cells."""
    field = GridField(step_cells=0.5, density_gain=1.0).double()
    field.reset(torch.ones(12, 12, 12, dtype=torch.bool), torch.full((3,), -1.2, dtype=torch.float64), 0.2)
    grid = torch.stack(
        torch.meshgrid(*[torch.linspace(-1.2, 1.2, 13, dtype=torch.float64)] * 3, indexing="ij"), -1
    )
    with torch.no_grad():
        field.table[:-1, 0] = (6.0 - 12.0 * grid.flatten(0, 2).norm(dim=-1)).clamp_min(-40.0)
        field.table[:-1, 1:] = torch.randn(13**3, 3, generator=generator, dtype=torch.float64)
    return field.eval().requires_grad_(False)
