"""Renders of every bin of every object, from which training images are composed with new backgrounds and shifts.

Fields do not change while psi is learned. The pool is rendered once and reused in all iterations, which saves most of
the rendering in the psi loop. Pathwise estimators cannot use a pool, because they differentiate the renders by psi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.product import HARD, Draws, HardDraws, SceneDistribution
from neural_sim.synthesis.assembly import RenderedObject
from neural_sim.synthesis.scene import CHUNK, Scene
from neural_sim.types import PinholeCamera, SceneDraw


def pool_cells(factors: Sequence[BinnedFactor], per_bin: int) -> tuple[int, int]:
    """Return the number of combinations of bins, and of maps for each such that every bin has at least ``per_bin``."""
    cells = math.prod(factor.bins for factor in factors)
    return cells, math.ceil(per_bin * max((factor.bins for factor in factors), default=1) / cells)


@dataclass(frozen=True)
class PooledSubject:
    """A subject whose draws are taken from stored renders, with replacement.

    Args:
        name: name of the object.
        maps: premultiplied RGBA in 8 bits, ``per_cell`` for each combination of the factors' bins (a cell); the last
            factor's bins change fastest.
        drawn: scene parameters of each map, cell by cell.
    """

    name: str
    maps: UInt8[Tensor, "cells per_cell height width 4"]
    drawn: SceneDraw

    @property
    def device(self) -> torch.device:
        """Device of the maps."""
        return self.maps.device

    @property
    def per_cell(self) -> int:
        """Number of maps of each cell."""
        return self.maps.shape[1]

    def __len__(self) -> int:
        return len(self.drawn)

    def part(self, within: slice) -> PooledSubject:
        """Return the maps ``within`` every cell, which share the memory of the whole."""
        rows = torch.arange(len(self)).view(-1, self.per_cell)[:, within].flatten()
        return PooledSubject(self.name, self.maps[:, within], self.drawn.select(rows))

    def draw(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        psi: Float[Tensor, "K"],
        count: int,
        generator: torch.Generator,
        how: Draws = HARD,
    ) -> RenderedObject:
        """See ``Subject``."""
        if not isinstance(how, HardDraws):
            raise ValueError(f"outer.pool_per_bin: a pool only has exact draws, got {how}")
        noise = how.noise(distribution, count, generator, torch.float32)
        within = torch.randint(self.per_cell, (count,), generator=generator)
        return self._taken(distribution, distribution.hard(psi.float(), noise).bins, within)

    def probe(
        self,
        camera: PinholeCamera,
        distribution: SceneDistribution,
        factor: str,
        per_bin: int,
        psi: Float[Tensor, "K"],
        generator: torch.Generator,
    ) -> RenderedObject:
        """See ``Subject``."""
        size = distribution.factor(factor).size
        bins, scenes = torch.arange(size).repeat_interleave(per_bin), torch.arange(per_bin).repeat(size)
        chosen = bins[:, None]
        if len(distribution.binned) > 1:
            noise = distribution.draw_noise(per_bin, generator).select(scenes)
            chosen = distribution.stratum(factor, bins, psi.float(), noise).bins
        within = torch.randint(self.per_cell, (per_bin,), generator=generator)
        return self._taken(distribution, chosen, within[scenes])

    def _taken(
        self, distribution: SceneDistribution, bins: Int[Tensor, "n factors"], within: Int[Tensor, "n"]
    ) -> RenderedObject:
        cell = torch.zeros(len(bins), dtype=torch.long)
        for column, factor in zip(bins.unbind(1), distribution.binned, strict=True):
            cell = cell * factor.bins + column
        maps = self.maps[cell.to(self.device), within.to(self.device)]
        return RenderedObject(self.drawn.select(cell * self.per_cell + within), maps[..., :3], maps[..., 3])


def pool_of(scene: Scene, per_bin: int, generator: torch.Generator, *, lights: bool = False) -> Scene:
    """Render at least ``per_bin`` maps of every bin of every factor and object; return a scene that draws from them.

    Args:
        scene: a scene of subjects that can be rendered.
        per_bin: number of maps of every bin; also of every anchor light, if ``lights``.
        generator: source of everything that the bins leave open.
        lights: if psi weighs lights, render each map under random weights, Dirichlet with parameter 1/2, instead of
            refusing. Draws from this pool then follow psi in their bins but not in their light.

    Raises:
        ValueError: ``per_bin`` is below 1, psi weighs lights but ``lights`` is not set, or a subject has only pictures.
    """
    if per_bin < 1:
        raise ValueError(f"outer.pool_per_bin must be at least 1 for a pool, got {per_bin}")
    distribution = scene.distribution
    if distribution.lights and not lights:
        raise ValueError("outer.pool_per_bin: a pool cannot follow lights that psi weighs, want 0")
    factors = distribution.binned
    cells, per_cell = pool_cells(factors, per_bin)
    per_cell = max(per_cell, math.ceil(per_bin * distribution.lights / cells))
    every = torch.zeros(1, 0, dtype=torch.long)
    if factors:
        every = torch.cartesian_prod(*(torch.arange(factor.bins) for factor in factors)).view(cells, -1)
    bins = every.repeat_interleave(per_cell, 0)
    named = dict(zip((factor.name for factor in factors), bins.unbind(1), strict=True))
    subjects = []
    for label, subject in enumerate(scene.rendered):
        # All combinations use the same random numbers, so that bins differ only by what the bin changes.
        noise = distribution.draw_noise(per_cell, generator, subject.dtype)
        noise = noise.select(torch.arange(per_cell).repeat(cells))
        draw = distribution.at_bins(named, noise)
        if distribution.lights:
            draw = replace(draw, weights=_mixed_lights(len(draw), distribution.lights, generator))
        maps, draw = _stored(scene, label, draw)
        subjects.append(PooledSubject(subject.name, maps.unflatten(0, (cells, per_cell)), draw))
    return replace(scene, subjects=tuple(subjects))


def _stored(scene: Scene, label: int, draw: SceneDraw) -> tuple[UInt8[Tensor, "n h w 4"], SceneDraw]:
    """Render an object's draws in chunks, because floats take many times the memory of the bytes that are stored.

    Returns:
        The maps, and the draws with the object's radius.
    """
    size = (len(draw), scene.camera.height, scene.camera.width, 4)
    maps = torch.empty(size, dtype=torch.uint8, device=scene.subjects[label].device)
    for rows in torch.arange(len(draw)).split(CHUNK):
        part = scene.render(label, draw.select(rows))
        pixels = torch.cat([part.rgb, part.opacity[..., None]], -1)
        maps[rows[0] : rows[-1] + 1] = pixels.mul_(255).round_().to(torch.uint8)
        draw = replace(draw, radius=part.draw.radius)
    return maps, draw


def _mixed_lights(count: int, lights: int, generator: torch.Generator) -> Float[Tensor, "count lights"]:
    """Draw weights from the Dirichlet distribution with parameter 1/2: squares of normal numbers, normalised."""
    squares = torch.randn(count, lights, generator=generator).square()
    return squares / squares.sum(-1, keepdim=True)
