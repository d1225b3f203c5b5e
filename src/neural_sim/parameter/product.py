"""p_psi over the scene's numbers V: a product of independent factors, everything that none of them learns uniform."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.parameter import bins as binned
from neural_sim.parameter.factor import BinnedFactor, BinNoise, Coordinate, Relaxation
from neural_sim.types import SceneDraw

COORDINATES: tuple[Coordinate, ...] = ("phi", "rho", "distance", "magnification")
"""The numbers of a :class:`SceneDraw` that images depend on smoothly."""


class Parameter(Protocol):
    """A configured parameter: the factors that it learns, and uniform ranges of what it draws beside them."""

    @property
    def factors(self) -> tuple[BinnedFactor, ...]: ...

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]: ...


@dataclass(frozen=True)
class Unlearned:
    """Ranges of numbers that no parameter of a run draws: angles in degrees, the distance in object radii.

    Raises:
        ValueError: a range that is not ordered, a distance within the object.
    """

    phi_deg: tuple[float, float] = (0.0, 360.0)
    rho_deg: tuple[float, float] = (-45.0, 45.0)
    distance: tuple[float, float] = (2.4, 4.0)

    def __post_init__(self) -> None:
        for name in ("phi_deg", "rho_deg", "distance"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"unlearned.{name} must be ordered, got {[low, high]}")
        if not self.distance[0] > 1.0:
            raise ValueError(f"unlearned.distance must be above 1 radius, got {list(self.distance)}")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """By coordinate, in radians and radii."""
        phi, rho = ((math.radians(r[0]), math.radians(r[1])) for r in (self.phi_deg, self.rho_deg))
        return {"phi": phi, "rho": rho, "distance": self.distance, "magnification": (1.0, 1.0)}


@dataclass(frozen=True)
class SceneNoise:
    """All randomness of n draws, made once and replayed by every pass (paper, Tool 2).

    ``bins`` picks each factor's bins. ``uniform`` in [0, 1) places each coordinate within its bin, or in its range
    where no factor draws it.
    """

    bins: Mapping[str, BinNoise]
    uniform: Mapping[str, Float[Tensor, "n"]]

    def __len__(self) -> int:
        return self.uniform["phi"].shape[0]


@dataclass(frozen=True)
class SceneDistribution:
    """p_psi = the product of the factors' distributions; psi is one vector an object, factor after factor.

    Raises:
        ValueError: no factor, two factors of one name, or two of one coordinate.
    """

    factors: tuple[BinnedFactor, ...]
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=lambda: Unlearned().ranges)

    def __post_init__(self) -> None:
        names = [factor.name for factor in self.factors]
        drawn = [factor.coordinate for factor in self.factors]
        if not names or len(set(names)) < len(names) or len(set(drawn)) < len(drawn):
            raise ValueError(
                f"parameter: want one or more factors of different names and coordinates, got {names} of {drawn}"
            )

    @staticmethod
    def of(parameters: Iterable[Parameter], unlearned: Unlearned | None = None) -> SceneDistribution:
        """The product of configured parameters."""
        parameters = tuple(parameters)
        ranges = (Unlearned() if unlearned is None else unlearned).ranges
        for parameter in parameters:
            ranges |= parameter.ranges
        return SceneDistribution(tuple(f for parameter in parameters for f in parameter.factors), ranges)

    # --- psi ---

    @property
    def names(self) -> tuple[str, ...]:
        """Of the factors, in their order."""
        return tuple(factor.name for factor in self.factors)

    @property
    def size(self) -> int:
        """How many numbers of psi an object has."""
        return sum(factor.size for factor in self.factors)

    def split(self, psi: Float[Tensor, "*n K"]) -> dict[str, Float[Tensor, "*n k"]]:
        """Every factor's part of psi, or of anything with a number for each of psi's."""
        parts = psi.split([factor.size for factor in self.factors], -1)
        return dict(zip(self.names, parts, strict=True))

    def join(self, parts: Mapping[str, Float[Tensor, "*n k"]]) -> Float[Tensor, "*n K"]:
        """Inverse of :meth:`split`."""
        return torch.cat([parts[name] for name in self.names], -1)

    def psi(self, which: str, objects: Sequence[str]) -> Float[Tensor, "objects K"]:
        """The configured ``initial`` or ``target`` psi of the objects, float64."""
        return torch.stack(
            [torch.cat([factor.psi(which, name) for factor in self.factors]) for name in objects]
        )

    def probabilities(self, psi: Float[Tensor, "*n K"]) -> dict[str, Float[Tensor, "*n k"]]:
        """Every factor's probabilities of its bins."""
        parts = self.split(psi)
        return {f.name: f.log_probabilities(parts[f.name]).exp() for f in self.factors}

    @property
    def biased(self) -> tuple[str, ...]:
        """Objects that some factor gives distributions of their own, sorted."""
        return tuple(sorted({name for factor in self.factors for name in factor.beliefs.biased or {}}))

    # --- draws ---

    def draw_noise(
        self,
        n: int,
        generator: torch.Generator,
        dtype: torch.dtype = torch.float32,
        antithetic: bool = False,
        conditional: int = 0,
    ) -> SceneNoise:
        """Randomness of n draws; independent of psi.

        ``antithetic``: Gumbel noise in pairs from uniforms u and 1 - u. ``conditional``: draws of the noise given the
        bin, for ``gumbel_rao``. Raises ``ValueError`` for an odd number of antithetic draws.
        """
        gumbel = {f.name: binned.gumbel((n, f.bins), generator, dtype, antithetic) for f in self.factors}
        drawn = [c for c in COORDINATES if c != "magnification" or self._binned(c)]
        uniform = torch.rand((len(drawn), n), generator=generator, dtype=torch.float64).to(dtype)
        noise = {
            f.name: BinNoise(gumbel[f.name], _exponential(n, conditional, f.bins, generator, dtype))
            for f in self.factors
        }
        return SceneNoise(noise, dict(zip(drawn, uniform, strict=True)))

    def hard(self, psi: Float[Tensor, "K"], noise: SceneNoise) -> SceneDraw:
        """Exact samples of p_psi; no derivative reaches psi."""
        parts = self.split(psi)
        return self.at_bins({f.name: f.hard(parts[f.name], noise.bins[f.name]) for f in self.factors}, noise)

    def at_bins(self, bins: Mapping[str, Int[Tensor, "n"]], noise: SceneNoise) -> SceneDraw:
        """Samples in given bins of every factor, uniform within each."""
        placed = {f.coordinate: f.at(bins[f.name], noise.uniform[f.coordinate]) for f in self.factors}
        return self._draw(placed, bins, noise)

    def relaxed(
        self, psi: Float[Tensor, "K"], noise: SceneNoise, relaxation: Relaxation = "gumbel_softmax"
    ) -> SceneDraw:
        """Samples that are differentiable in psi, see :meth:`BinnedFactor.relaxed`."""
        parts, placed, bins = self.split(psi), {}, {}
        for f in self.factors:
            within = noise.uniform[f.coordinate]
            placed[f.coordinate], bins[f.name] = f.relaxed(
                parts[f.name], noise.bins[f.name], within, relaxation
            )
        return self._draw(placed, bins, noise)

    def stratum(
        self, name: str, bins: Int[Tensor, "n"], psi: Float[Tensor, "K"], noise: SceneNoise
    ) -> SceneDraw:
        """Samples in given bins of one factor, all others drawn from p_psi."""
        parts = self.split(psi)
        others = {f.name: f.hard(parts[f.name], noise.bins[f.name]) for f in self.factors if f.name != name}
        return self.at_bins({**others, name: bins}, noise)

    def log_prob(self, psi: Float[Tensor, "K"], bins: Int[Tensor, "n factors"]) -> Float[Tensor, "n"]:
        """log-probability of drawn bins (for REINFORCE)."""
        parts = self.split(psi)
        logs = [f.log_probabilities(parts[f.name])[bins[:, i]] for i, f in enumerate(self.factors)]
        return torch.stack(logs).sum(0)

    def bins_of(self, draw: SceneDraw) -> Int[Tensor, "n factors"]:
        """The bins that each draw lies in, whatever bins it was drawn for."""
        return torch.stack([f.bin_of(getattr(draw, f.coordinate)) for f in self.factors], -1)

    def _binned(self, coordinate: Coordinate) -> bool:
        return any(f.coordinate == coordinate for f in self.factors)

    def _draw(
        self,
        placed: Mapping[str, Float[Tensor, "n"]],
        bins: Mapping[str, Int[Tensor, "n"]],
        noise: SceneNoise,
    ) -> SceneDraw:
        values = {}
        for coordinate in COORDINATES:
            low, high = self.ranges[coordinate]
            if coordinate in placed:
                values[coordinate] = placed[coordinate]
            elif coordinate in noise.uniform:
                values[coordinate] = low + (high - low) * noise.uniform[coordinate]
        return SceneDraw(**values, bins=torch.stack([bins[name] for name in self.names], -1))


def _exponential(
    n: int, conditional: int, bins: int, generator: torch.Generator, dtype: torch.dtype
) -> Tensor | None:
    if not conditional:
        return None
    empty = torch.empty(n, conditional, bins, dtype=torch.float64)
    return empty.exponential_(generator=generator).clamp_min(1e-30).to(dtype)
