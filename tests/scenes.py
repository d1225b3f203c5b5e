"""A made scene for captures: a textured table in a textured room, seen by any rays. Closed form, without meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch.nn import functional

from neural_sim.synthesis.background import ProceduralClutter

TEXELS = 384


@dataclass(frozen=True)
class Room:
    """Of the object's frame (+z up, radii): a box ``half`` to all sides about the origin, and a round table.

    ``table``: height and radius of its top, None: no table, the object hangs in the room. ``seed`` is the textures'.
    """

    half: tuple[float, float, float] = (11.0, 9.0, 7.0)
    table: tuple[float, float] | None = (-0.8, 4.0)
    seed: int = 5

    def colours(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """What rays (n, 3) see, from inside of the room: RGB (n, 3) in [0, 1]."""
        walls = _textures(self.seed)
        half, safe = np.array(self.half), np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        leaving = (np.sign(safe) * half - origins) / safe
        axis = leaving.argmin(1)
        distance = leaving.min(1)
        at = (origins + distance[:, None] * directions) / half
        side = 2 * axis + (np.take_along_axis(safe, axis[:, None], 1)[:, 0] > 0)
        seen = np.zeros((len(origins), 3))
        for wall in range(6):
            here = side == wall
            seen[here] = _look_up(walls[wall], np.delete(at[here], wall // 2, 1))
        if self.table is not None:
            height, radius = self.table
            down = (height - origins[:, 2]) / safe[:, 2]
            point = (origins + down[:, None] * directions)[:, :2] / radius
            on = (down > 0.0) & (down < distance) & (np.linalg.norm(point, axis=1) < 1.0)
            seen[on] = _look_up(walls[6], point[on])
        return seen


@cache
def _textures(seed: int) -> torch.Tensor:
    # Cameras of photographs are found by what surfaces show, so there is much on them.
    return ProceduralClutter(shapes=40, grain=0.06).draw(
        7, TEXELS, TEXELS, torch.Generator().manual_seed(seed)
    )


def _look_up(texture: torch.Tensor, at: np.ndarray) -> np.ndarray:
    """Bilinear, for coordinates in [-1, 1]."""
    grid = torch.from_numpy(at).float().view(1, -1, 1, 2)
    return (
        functional.grid_sample(texture[None], grid, padding_mode="border", align_corners=False)[0, :, :, 0]
        .t()
        .double()
        .numpy()
    )
