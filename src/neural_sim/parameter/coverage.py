"""Find the bins of p_psi that the photographs of an object show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.parameter.factor import COORDINATES
from neural_sim.parameter.product import SceneDistribution, SceneNoise

STEPS = 5
"""Number of poses along each angle of a bin that are compared with the photographs."""
LEAST = 0.5
"""Smallest fraction of a bin's poses that must be near a photograph for the bin to count as covered."""


@dataclass(frozen=True)
class Coverage:
    """The fraction of each bin's poses whose direction is within ``within_deg`` of a photograph's."""

    fractions: tuple[float, ...]
    within_deg: float

    @property
    def covered(self) -> tuple[bool, ...]:
        """For each bin, whether at least the fraction ``LEAST`` of its poses is near a photograph."""
        return tuple(fraction >= LEAST for fraction in self.fractions)

    @property
    def missing(self) -> list[int]:
        """The bins, numbered from 1, that are not covered."""
        return [number + 1 for number, covered in enumerate(self.covered) if not covered]


def coverage(
    distribution: SceneDistribution, factor: str, directions: Float[Tensor, "photos 3"], within_deg: float
) -> Coverage | None:
    """Compute how much of each bin of a factor photographs cover; None if its bins are not directions.

    Args:
        distribution: the distribution of poses; the angle that the factor does not draw covers its whole range.
        factor: name of the factor.
        directions: unit vectors from the object to the photographs' cameras, in the object's frame.
        within_deg: largest angle in degrees at which a photograph is near a pose.
    """
    (own,) = (f for f in distribution.binned if f.name == factor)
    if own.coordinate not in ("phi", "rho"):
        return None
    inner = (torch.arange(STEPS, dtype=torch.float64) + 0.5) / STEPS
    first, second = (part.flatten() for part in torch.meshgrid(inner, inner, indexing="ij"))
    learned = {f.coordinate for f in distribution.binned}
    uniform = {c: torch.full_like(first, 0.5) for c in COORDINATES if c != "magnification" or c in learned}
    uniform |= {own.coordinate: first, "rho" if own.coordinate == "phi" else "phi": second}
    fractions: list[float] = []
    for number in range(own.bins):
        bins = {
            # As ``second`` goes from 0 to 1, the other factors run through all of their bins.
            f.name: torch.full((len(first),), number) if f is own else (second * f.bins).long()
            for f in distribution.binned
        }
        within = {
            f.coordinate: (second * f.bins) % 1.0
            for f in distribution.binned
            if f is not own and f.coordinate in ("phi", "rho")
        }
        draw = distribution.at_bins(bins, SceneNoise({}, uniform | within))
        toward = orbit(draw.phi, draw.rho, torch.ones_like(draw.phi))[:, :3, 3]
        nearest = (toward @ directions.double().t()).amax(1).clamp(-1.0, 1.0).acos()
        fractions.append(float((nearest <= math.radians(within_deg)).double().mean()))
    return Coverage(tuple(fractions), within_deg)


def coverages(
    distribution: SceneDistribution, directions: Mapping[str, Float[np.ndarray, "_ 3"]], within_deg: float
) -> dict[str, dict[str, Coverage]]:
    """Compute ``coverage`` by object and factor, for all factors whose bins are directions."""
    found: dict[str, dict[str, Coverage]] = {}
    for name, seen in directions.items():
        every = {
            f.name: coverage(distribution, f.name, torch.tensor(seen), within_deg)
            for f in distribution.binned
        }
        found[name] = {factor: own for factor, own in every.items() if own is not None}
    return found
