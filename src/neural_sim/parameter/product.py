"""p_psi over the scene parameters V: a product of independent factors; coordinates without a factor are uniform."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, cast

import torch
from jaxtyping import Float, Int, Num
from torch import Tensor
from torch.nn.functional import one_hot

from neural_sim.digests import tensor_digest
from neural_sim.parameter import bins as binned
from neural_sim.parameter.bins import BinNoise
from neural_sim.parameter.distributions import distribution
from neural_sim.parameter.factor import COORDINATES, BinnedFactor, Factor
from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.unlearned import Unit, Unlearned, radii_in_metres
from neural_sim.types import SceneDraw


class Parameter(Protocol):
    """A configured parameter: its factors, and the ranges of coordinates that it draws uniformly."""

    @property
    def factors(self) -> tuple[Factor, ...]:
        """The factors that are learned."""
        ...

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Uniform ranges of coordinates that are not learned, in radians."""
        ...


class Covered(Protocol):
    """Coverage of the bins of a factor by photographs."""

    @property
    def missing(self) -> list[int]:
        """The bins, numbered from 1, that are not covered."""
        ...


@dataclass(frozen=True)
class SceneNoise:
    """All randomness of n draws, drawn once and replayed in every pass (paper, Tool 2).

    ``bins`` selects each factor's bins. ``uniform``, in [0, 1), places each coordinate within its bin, or within its
    range if no factor draws it. ``light`` is standard normal, for lights drawn around psi's weights; None: the lights
    are psi's weights.
    """

    bins: Mapping[str, BinNoise]
    uniform: Mapping[str, Float[Tensor, "n"]]
    light: Float[Tensor, "n k"] | None = None

    def __len__(self) -> int:
        return len(self.uniform["phi"])

    def select(self, index: Int[Tensor, "k"]) -> SceneNoise:
        """Select draws by index, repeats allowed."""
        bins = {name: part.select(index) for name, part in self.bins.items()}
        uniform = {name: values[index] for name, values in self.uniform.items()}
        return SceneNoise(bins, uniform, None if self.light is None else self.light[index])


@dataclass(frozen=True)
class SceneDistribution:
    """p_psi, the product of the factors' distributions; psi is one vector for each object, factor by factor.

    ``ranges`` are those of coordinates that no factor draws; distances are in ``distance_unit``.

    Raises:
        ValueError: there is no factor, or two factors share a name or a coordinate.
    """

    factors: tuple[Factor, ...]
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=lambda: Unlearned().ranges)
    distance_unit: Unit = "radii"

    def __post_init__(self) -> None:
        names = [factor.name for factor in self.factors]
        drawn = [factor.coordinate for factor in self.binned]
        if not names or len(set(names)) < len(names) or len(set(drawn)) < len(drawn):
            raise ValueError(
                f"parameter: want at least one factor, and different names and coordinates, got {names} and {drawn}"
            )

    @staticmethod
    def of(parameters: Iterable[Parameter], unlearned: Unlearned | None = None) -> SceneDistribution:
        """Build the product of configured parameters."""
        parameters = tuple(parameters)
        unlearned = Unlearned() if unlearned is None else unlearned
        ranges, unit = unlearned.ranges, unlearned.distance_unit
        for parameter in parameters:
            ranges |= parameter.ranges
            if any(getattr(factor, "coordinate", None) == "distance" for factor in parameter.factors):
                unit = cast(Unit, getattr(parameter, "unit", "radii"))
        return SceneDistribution(
            tuple(f for parameter in parameters for f in parameter.factors), ranges, unit
        )

    def radii(self, sizes: Mapping[str, float | None]) -> tuple[float, ...] | None:
        """Return the objects' radii if distances are in metres, see ``radii_in_metres``; otherwise None."""
        if self.distance_unit == "radii":
            return None
        nearest = next((f.low for f in self.binned if f.coordinate == "distance"), self.ranges["distance"][0])
        return radii_in_metres(nearest, sizes)

    @property
    def binned(self) -> tuple[BinnedFactor, ...]:
        """The factors that draw bins."""
        return tuple(factor for factor in self.factors if isinstance(factor, BinnedFactor))

    @property
    def lights(self) -> int:
        """Number of anchor lights; 0 if the light is fixed."""
        return sum(factor.lights for factor in self.factors)

    @property
    def _light(self) -> Illumination | None:
        return next((factor for factor in self.factors if isinstance(factor, Illumination)), None)

    def factor(self, name: str) -> Factor:
        """Find a factor by its name."""
        return self.factors[self.names.index(name)]

    @property
    def drawn(self) -> dict[str, Any]:
        """The settings on which hard draws at given probabilities depend: neither relaxation nor floor."""
        drawn = {"factors": [factor.drawn for factor in self.factors], "ranges": dict(self.ranges)}
        return drawn | {"distance_unit": self.distance_unit}

    # --- psi ---

    @property
    def names(self) -> tuple[str, ...]:
        """The factors' names, in order."""
        return tuple(factor.name for factor in self.factors)

    @property
    def size(self) -> int:
        """Number of psi's entries for each object."""
        return sum(factor.size for factor in self.factors)

    def split(self, psi: Float[Tensor, "*n K"]) -> dict[str, Float[Tensor, "*n _"]]:
        """Split psi, or any vector of psi's shape, into the factors' parts."""
        parts = torch.split(psi, [factor.size for factor in self.factors], -1)
        return dict(zip(self.names, parts, strict=True))

    def join(self, parts: Mapping[str, Float[Tensor, "*n _"]]) -> Float[Tensor, "*n K"]:
        """Invert ``split``."""
        return torch.cat([parts[name] for name in self.names], -1)

    def psi(self, which: str, objects: Sequence[str]) -> Float[Tensor, "objects K"]:
        """Compute the configured ``initial`` or ``target`` psi of the objects, float64."""
        return torch.stack(
            [torch.cat([factor.psi(which, name) for factor in self.factors]) for name in objects]
        )

    def leaving_out(self, covered: Mapping[str, Mapping[str, Covered]]) -> SceneDistribution:
        """Return this distribution with p = 0 in the bins that are not ``covered``, by object and factor.

        Raises:
            ValueError: an object has no bin left.
        """
        factors: list[Factor] = []
        for factor in self.factors:
            closed = {
                name: tuple(own[factor.name].missing) for name, own in covered.items() if factor.name in own
            }
            for name, bins in closed.items():
                if len(bins) == factor.size:
                    raise ValueError(
                        f"parameter.{factor.name}: no bin of {name} is near a photograph; check objects.up and poses, "
                        "or set parameter.pose.uncovered=render"
                    )
            if isinstance(factor, BinnedFactor) and any(closed.values()):
                factor = replace(factor, configured=replace(factor.configured, closed=closed))
            factors.append(factor)
        return replace(self, factors=tuple(factors))

    def uniform_of(self, objects: Sequence[str]) -> Float[Tensor, "objects K"]:
        """Compute the psi of uniform open bins and equal weights of lights, for each object."""
        even = [(f, distribution("uniform", f.size)) for f in self.factors]
        return torch.stack([torch.cat([f.psi_of(p, f.closed(name)) for f, p in even]) for name in objects])

    @property
    def uniform(self) -> Float[Tensor, "K"]:
        """The psi of uniform bins and equal weights of lights."""
        return torch.cat([f.psi_of(distribution("uniform", f.size)) for f in self.factors])

    def probabilities(self, psi: Float[Tensor, "*n K"]) -> dict[str, Float[Tensor, "*n _"]]:
        """Compute the probabilities of every factor's bins, and the weights of the lights."""
        parts = self.split(psi)
        return {f.name: f.p_of(parts[f.name]) for f in self.factors}

    def digest_of(self, psi: Float[Tensor, "objects K"]) -> str:
        """Digest the probabilities and weights at psi, rounded to 12 decimal places."""
        p = self.probabilities(psi.detach().cpu().double())
        return tensor_digest([(p[name] * 1e12).round() + 0.0 for name in self.names])

    def constrained(self, psi: Float[Tensor, "*n K"]) -> Float[Tensor, "*n K"]:
        """Project every factor's part of psi onto its constraint."""
        parts = self.split(psi)
        return self.join({f.name: f.project(parts[f.name]) for f in self.factors})

    @property
    def biased(self) -> tuple[str, ...]:
        """Names of the objects that some factor's ``biased`` lists, sorted."""
        return tuple(sorted({name for factor in self.factors for name in factor.configured.biased or {}}))

    @property
    def states_target(self) -> bool:
        """Whether any factor configures a target; the default is uniform."""
        return any(factor.configured.states_target for factor in self.factors)

    # --- draws ---

    def draw_noise(
        self,
        n: int,
        generator: torch.Generator,
        dtype: torch.dtype = torch.float32,
        *,
        explore: bool = False,
        balanced: bool = False,
    ) -> SceneNoise:
        """Draw the randomness of n draws, which does not depend on psi.

        Args:
            n: number of draws.
            generator: the source of all random numbers.
            dtype: dtype of the noise.
            explore: whether to draw lights around psi's, for estimators that need a density.
            balanced: whether exact draws fall into each bin of a factor n p times, rounded down or up.
        """
        gumbel = {f.name: binned.gumbel((n, f.bins), generator, dtype) for f in self.binned}
        learned = {f.coordinate for f in self.binned}
        drawn = [c for c in COORDINATES if c != "magnification" or c in learned]
        uniform = torch.rand((len(drawn), n), generator=generator, dtype=torch.float64).to(dtype)
        noise: dict[str, BinNoise] = {}
        for f in self.binned:
            offset = float(torch.rand((), generator=generator, dtype=torch.float64)) if balanced else None
            noise[f.name] = BinNoise(gumbel[f.name], offset)
        light = None
        if explore and self.lights:
            light = torch.randn((n, self.lights), generator=generator, dtype=torch.float64).to(dtype)
        return SceneNoise(noise, dict(zip(drawn, uniform.unbind(), strict=True)), light)

    def hard(self, psi: Float[Tensor, "K"], noise: SceneNoise) -> SceneDraw:
        """Draw exact samples of p_psi; not differentiable in psi."""
        parts = self.split(psi)
        bins = {f.name: f.hard(parts[f.name], noise.bins[f.name]) for f in self.binned}
        return self.lit(self.at_bins(bins, noise), psi.detach(), noise.light)

    def at_bins(self, bins: Mapping[str, Int[Tensor, "n"]], noise: SceneNoise) -> SceneDraw:
        """Draw samples in given bins of every factor, uniform within each bin; sets no light."""
        placed = {f.coordinate: f.at(bins[f.name], noise.uniform[f.coordinate]) for f in self.binned}
        return self._draw(placed, bins, noise)

    def lit(
        self, draw: SceneDraw, psi: Float[Tensor, "K"], noise: Float[Tensor, "n k"] | None = None
    ) -> SceneDraw:
        """Put draws under psi's light, differentiably; with ``noise``, under lights drawn around it, detached."""
        if self._light is None:
            return draw
        weights = self.split(psi)[self._light.name]
        if noise is None:
            return replace(draw, weights=self._light.draw(weights, len(draw)))
        drawn = self._light.explore(weights, noise)
        return replace(draw, weights=drawn.weights, explored=drawn.unprojected)

    def relaxed(self, psi: Float[Tensor, "K"], noise: SceneNoise) -> SceneDraw:
        """Draw samples that are differentiable in psi, see ``BinnedFactor.relaxed``."""
        parts = self.split(psi)
        placed: dict[str, Tensor] = {}
        bins: dict[str, Tensor] = {}
        for f in self.binned:
            within = noise.uniform[f.coordinate]
            placed[f.coordinate], bins[f.name] = f.relaxed(parts[f.name], noise.bins[f.name], within)
        return self.lit(self._draw(placed, bins, noise), psi)

    def probes(
        self, name: str, each: int, psi: Float[Tensor, "K"], generator: torch.Generator, dtype: torch.dtype
    ) -> SceneDraw:
        """Draw ``each`` samples in every stratum of one factor, stratum after stratum.

        Everything else is drawn from p_psi and is the same in all strata.
        """
        size, lights = self.factor(name).size, self.factor(name).lights
        strata = torch.arange(size).repeat_interleave(each)
        noise = self.draw_noise(each, generator, dtype).select(torch.arange(each).repeat(size))
        if not lights:
            return self.stratum(name, strata, psi, noise)
        return replace(self.hard(psi, noise), weights=torch.eye(size, dtype=psi.dtype)[strata])

    def stratum(
        self, name: str, bins: Int[Tensor, "n"], psi: Float[Tensor, "K"], noise: SceneNoise
    ) -> SceneDraw:
        """Draw samples in given bins of one factor, with the bins of the others drawn from p_psi."""
        parts = self.split(psi)
        others = {f.name: f.hard(parts[f.name], noise.bins[f.name]) for f in self.binned if f.name != name}
        return self.lit(self.at_bins({**others, name: bins}, noise), psi.detach())

    def log_prob(self, psi: Float[Tensor, "K"], draw: SceneDraw) -> Float[Tensor, "n"]:
        """Compute log p of the drawn bins and explored lights (for REINFORCE).

        Raises:
            ValueError: a light was not explored, so it has no density.
        """
        parts = self.split(psi)
        logs = [f.log_probabilities(parts[f.name])[draw.bins[:, i]] for i, f in enumerate(self.binned)]
        if self._light is not None:
            if draw.explored is None:
                raise ValueError("parameter.illumination: lights that were not drawn have no density")
            logs.append(self._light.log_prob(parts[self._light.name], draw.explored))
        return torch.stack(logs).sum(0)

    def statistics(self, draw: SceneDraw) -> dict[str, Num[Tensor, "n _"]]:
        """Compute sufficient statistics for each factor's psi.

        For bins they are the drawn bin as a one-hot vector; for lights, the drawn weights before their projection,
        centred. Lights that were not drawn around psi have none.
        """
        statistics = {f.name: one_hot(draw.bins[:, i], f.size) for i, f in enumerate(self.binned)}
        if self._light is not None and draw.explored is not None:
            statistics[self._light.name] = draw.explored - draw.explored.mean(-1, keepdim=True)
        return statistics

    def bins_of(self, draw: SceneDraw) -> Int[Tensor, "n factors"]:
        """Find the bins of each draw's coordinates, see ``BinnedFactor.stratum_of``; one column per binned factor."""
        return _columns([f.stratum_of(draw) for f in self.binned], draw.phi)

    def _draw(
        self,
        placed: Mapping[str, Float[Tensor, "n"]],
        bins: Mapping[str, Int[Tensor, "n"]],
        noise: SceneNoise,
    ) -> SceneDraw:
        values: dict[str, Tensor] = {}
        for coordinate in COORDINATES:
            low, high = self.ranges[coordinate]
            if coordinate in placed:
                values[coordinate] = placed[coordinate]
            elif coordinate in noise.uniform:
                values[coordinate] = low + (high - low) * noise.uniform[coordinate]
        return SceneDraw(
            phi=values["phi"],
            rho=values["rho"],
            distance=values["distance"],
            magnification=values.get("magnification"),
            bins=_columns([bins[f.name] for f in self.binned], values["phi"]),
        )


@dataclass(frozen=True)
class RelaxedDraws:
    """Draws that depend smoothly on psi, for the pathwise estimator.

    ``tangents``: also render the images' derivatives with respect to those coordinates of a draw that depend on psi.
    """

    tangents: bool = False

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Draw the random numbers of ``count`` draws of one object."""
        return distribution.draw_noise(count, generator, dtype)


@dataclass(frozen=True)
class HardDraws:
    """Exact samples of p_psi, by default balanced over the bins.

    ``explore``: draw independent samples, and lights around psi's, for estimators that need the draws' joint density.
    """

    explore: bool = False

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Draw the random numbers of ``count`` draws of one object."""
        return distribution.draw_noise(
            count, generator, dtype, explore=self.explore, balanced=not self.explore
        )


Draws = HardDraws | RelaxedDraws
HARD = HardDraws()


def _columns(bins: Sequence[Tensor], like: Tensor) -> Int[Tensor, "n factors"]:
    """Join bins as the columns of one table; [n, 0] without factors."""
    return torch.stack(list(bins), -1) if bins else torch.zeros(len(like), 0, dtype=torch.long)
