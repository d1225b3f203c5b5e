"""Rendered maps of every bin of every object, from which training images are composed with new backgrounds and shifts.

Fields do not change while psi is learned, so every bin is rendered once and its maps are reused in all iterations,
which saves most rendering of the psi loop. Pathwise estimators cannot use a pool: they differentiate draws from psi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from neural_sim.parameter.factor import BinnedFactor
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.draws import HARD, Draws, HardDraws
from neural_sim.synthesis.scene import Scene
from neural_sim.types import SceneDraw


def pool_cells(factors: Sequence[BinnedFactor], per_bin: int) -> tuple[int, int]:
    """Number of combinations of the factors' bins, and of maps of each that give every bin at least ``per_bin``."""
    cells = math.prod(factor.bins for factor in factors)
    return cells, math.ceil(per_bin * max(factor.bins for factor in factors) / cells)


@dataclass(frozen=True)
class ObjectPool:
    """``per_cell`` maps of every cell of one object, cell by cell, the last factor's bins changing fastest.

    ``maps`` are premultiplied RGBA in 8 bits, ``draw`` the scene of each.
    """

    maps: UInt8[Tensor, "n height width 4"]
    draw: SceneDraw
    per_cell: int


@dataclass(frozen=True)
class ImagePool:
    """The pools of all objects, in the order of their labels."""

    scene: Scene
    objects: tuple[ObjectPool, ...]

    @staticmethod
    def render(scene: Scene, per_bin: int, generator: torch.Generator) -> ImagePool:
        """Render at least ``per_bin`` maps of every bin of every factor and object.

        Raises:
            ValueError: fewer than one, or a light that moves with psi.
        """
        if per_bin < 1:
            raise ValueError(f"outer.pool_per_bin must be at least 1 for a pool, got {per_bin}")
        if scene.distribution.lights:
            raise ValueError("outer.pool_per_bin: a pool has no images under a light that moves, want 0")
        factors = scene.distribution.binned
        cells, per_cell = pool_cells(factors, per_bin)
        every = torch.cartesian_prod(*(torch.arange(factor.bins) for factor in factors)).view(cells, -1)
        bins = every.repeat_interleave(per_cell, 0)
        named = dict(zip((factor.name for factor in factors), bins.unbind(1), strict=True))
        pools = []
        for label in range(len(scene.names)):
            # The same numbers in every cell: differences between bins then owe nothing to what is not their own.
            noise = scene.distribution.draw_noise(per_cell, generator, scene.dtype(label))
            noise = noise.select(torch.arange(per_cell).repeat(cells))
            part = scene.render(label, scene.distribution.at_bins(named, noise))
            maps = torch.cat([part.rgb, part.opacity[..., None]], -1)
            pools.append(ObjectPool((maps * 255).round().to(torch.uint8), part.draw, per_cell))
        return ImagePool(scene, tuple(pools))

    def drawn(
        self, label: int, psi: Float[Tensor, "K"], count: int, generator: torch.Generator, how: Draws = HARD
    ) -> RenderedObject:
        """One object alone, ``count`` times from p_psi, its maps drawn with replacement.

        Raises:
            ValueError: for relaxed draws.
        """
        if not isinstance(how, HardDraws):
            raise ValueError(f"outer.pool_per_bin: a pool has exact draws alone, got {how}")
        noise = how.noise(self.scene.distribution, count, generator, torch.float32)
        within = torch.randint(self.objects[label].per_cell, (count,), generator=generator)
        return self._taken(label, self.scene.distribution.hard(psi.float(), noise).bins, within)

    def probed(
        self, label: int, factor: str, per_bin: int, psi: Float[Tensor, "K"], generator: torch.Generator
    ) -> RenderedObject:
        """One object alone, ``per_bin`` times in every bin of a factor, in the order of its bins; all else from p_psi
        and the same in all bins.
        """
        distribution = self.scene.distribution
        size = distribution.factor(factor).size
        bins, scenes = torch.arange(size).repeat_interleave(per_bin), torch.arange(per_bin).repeat(size)
        chosen = bins[:, None]
        if len(distribution.binned) > 1:
            noise = distribution.draw_noise(per_bin, generator).select(scenes)
            chosen = distribution.stratum(factor, bins, psi.float(), noise).bins
        within = torch.randint(self.objects[label].per_cell, (per_bin,), generator=generator)
        return self._taken(label, chosen, within[scenes])

    def _taken(self, label: int, bins: Int[Tensor, "n factors"], within: Int[Tensor, "n"]) -> RenderedObject:
        pool = self.objects[label]
        cell = torch.zeros(len(bins), dtype=torch.long)
        for column, factor in zip(bins.unbind(1), self.scene.distribution.binned, strict=True):
            cell = cell * factor.bins + column
        index = cell * pool.per_cell + within
        maps = pool.maps[index.to(pool.maps.device)].float() / 255
        return RenderedObject(pool.draw.select(index), maps[..., :3], maps[..., 3])
