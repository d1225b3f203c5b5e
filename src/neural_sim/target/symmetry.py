"""Find the bins of a factor that an object's symmetry makes equal; probability in one of them counts for all."""

from __future__ import annotations

import itertools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.parameter.bins import BinNoise
from neural_sim.parameter.factor import COORDINATES
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.types import PinholeCamera, SceneDraw


def equivalent_bins(
    item: RenderedSubject,
    distribution: SceneDistribution,
    factor: str,
    camera: PinholeCamera,
    samples: int = 6,
    tolerance: float = 0.01,
) -> list[list[int]]:
    """Group a factor's bins (from 0) whose views agree, in lists that cover all bins.

    Two bins belong together if their premultiplied views agree under one of four alignments of the angles within them
    (the offset in the bin and the second angle, each unchanged or mirrored about the middle of its range): the mean
    absolute difference over the pixels that either view covers must be below ``tolerance``. A second angle with a full
    circle as its range is also shifted by half a turn. Views of every bin use the same ``samples`` offsets and second
    angles; other coordinates are at the middle of their range.
    """
    count = next(f.bins for f in distribution.binned if f.name == factor)
    views = _views(item, distribution, factor, camera, count, samples)
    groups: list[list[int]] = []
    for b in range(count):
        home = next((group for group in groups if _same(views[group[0]][0], views[b], tolerance)), None)
        if home is None:
            groups.append([b])
        else:
            home.append(b)
    return groups


def _views(
    item: RenderedSubject,
    distribution: SceneDistribution,
    factor: str,
    camera: PinholeCamera,
    bins: int,
    samples: int,
) -> Float[Tensor, "bins alignments samples h w 4"]:
    """Render premultiplied views of every bin and alignment in one pass, which prepares a mesh's texture once."""
    offsets = (torch.arange(samples) + 0.5) / samples
    other = torch.linspace(0.1, 0.9, samples)[torch.arange(samples) * 5 % samples]
    turns = (0.0, 0.5) if _second_goes_round(distribution, factor) else (0.0,)
    radius = (distribution.radii({item.name: item.radius}) or (1.0,))[0]
    aligned = list(itertools.product((offsets, 1.0 - offsets), (other, 1.0 - other), turns))
    draws = [
        _at(distribution, factor, b, within, (second + turn) % 1.0)
        for b in range(bins)
        for within, second, turn in aligned
    ]
    poses = torch.cat([orbit(draw.phi, draw.rho, draw.distance, radius=radius) for draw in draws])
    return item.maps(camera, poses).rgba.unflatten(0, (bins, len(aligned), samples))


def _second_goes_round(distribution: SceneDistribution, factor: str) -> bool:
    """Tell whether the other angle, which is not the factor's own, covers the full circle."""
    own = next(f.coordinate for f in distribution.binned if f.name == factor)
    second = "phi" if own == "rho" else "rho"
    low, high = next(((f.low, f.high) for f in distribution.binned if f.coordinate == second),
                     distribution.ranges[second])  # fmt: skip
    return math.isclose(high - low, 2.0 * math.pi)


def _at(
    distribution: SceneDistribution,
    factor: str,
    bin_index: int,
    within: Float[Tensor, "n"],
    other: Float[Tensor, "n"],
) -> SceneDraw:
    """Return scenes in one bin of a factor, with other angles at the fractions ``other`` of their ranges."""
    middle = torch.full_like(within, 0.5)
    uniform = {name: other if name in ("phi", "rho") else middle for name in COORDINATES}
    bins, still = {}, {}
    for f in distribution.binned:
        if f.name == factor:
            bins[f.name], uniform[f.coordinate] = torch.full((len(within),), bin_index), within
        else:
            at = uniform[f.coordinate] * f.bins
            bins[f.name], uniform[f.coordinate] = at.long().clamp_max(f.bins - 1), at.frac()
        still[f.name] = BinNoise(torch.zeros(len(within), f.bins))
    return distribution.at_bins(bins, SceneNoise(still, uniform))


def _same(reference: Tensor, candidates: Tensor, tolerance: float) -> bool:
    return any(_difference(reference, candidate) < tolerance for candidate in candidates)


def _difference(a: Tensor, b: Tensor) -> float:
    covered = (a[..., 3] > 0) | (b[..., 3] > 0)
    return float((a - b).abs().mean(-1)[covered].mean()) if bool(covered.any()) else 0.0
