"""Factors of p_psi: the interface that all of them share, and the factor with bins of one coordinate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, get_args

import torch
from annotated_types import Ge, Lt
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.parameter import bins as binned
from neural_sim.parameter.bins import BinNoise
from neural_sim.parameter.distributions import Biased, Specification, distribution
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import SceneDraw

Coordinate = Literal["phi", "rho", "distance", "magnification"]
COORDINATES: tuple[Coordinate, ...] = get_args(Coordinate)
"""The numbers of a ``SceneDraw`` that place the camera and set its focal length; images depend smoothly on them."""
Gap = Literal["disjoint", "uniform", "same"]
Floor = Annotated[float, Ge(0), Lt(1)]
"""Smallest probability of a bin; must be less than 1 / (number of bins)."""


@validated
@dataclass(frozen=True)
class ConfiguredDistributions:
    """Initial and target distributions of one factor for each object, as configured.

    Args:
        initial, target: the distributions of objects that are not named in ``biased``.
        biased: object name -> {initial: ..., target: ...}, see ``distributions.distribution``.
        gap: where biased objects start: ``disjoint``, at the initial distribution in ``biased``; ``uniform``; or
            ``same``, at their target.
        closed: object name -> numbers, from 1, of its bins from which nothing is drawn, whatever the distributions say.
    """

    initial: Specification = "uniform"
    target: Specification = "uniform"
    biased: Biased | None = None
    gap: Gap = "disjoint"
    closed: Mapping[str, tuple[int, ...]] | None = None

    def of(self, which: str, object_name: str) -> Specification:
        """Look up the ``initial`` or ``target`` specification of one object."""
        given = (self.biased or {}).get(object_name)
        if given is None:
            return self.initial if which == "initial" else self.target
        own = {str(key): specification for key, specification in given.items()}
        if which == "initial" and self.gap != "disjoint":
            return "uniform" if self.gap == "uniform" else own.get("target", self.target)
        return own.get(which, self.initial if which == "initial" else self.target)

    @property
    def states_target(self) -> bool:
        """Whether any object has a target other than uniform, the default."""
        own = [biased.get("target", self.target) for biased in (self.biased or {}).values()]
        return any(target != "uniform" for target in [self.target, *own])


class Factor(Protocol):
    """One factor of p_psi, with its part of psi: ``size`` numbers, one for each stratum (bin or anchor light).

    ``update`` names the setting of the psi loop that chooses its optimiser.
    """

    update: ClassVar[str]

    @property
    def name(self) -> str:
        """The name of the configuration node ``parameter.<name>``."""
        ...

    @property
    def size(self) -> int:
        """Number of psi's entries for each object."""
        ...

    @property
    def lights(self) -> int:
        """Number of anchor lights.

        If it is above 0, psi changes the images themselves, not only how often each is drawn.
        """
        ...

    @property
    def configured(self) -> ConfiguredDistributions:
        """The configured distributions, by object."""
        ...

    @property
    def drawn(self) -> dict[str, Any]:
        """The settings on which hard draws at given probabilities depend."""
        ...

    def psi(self, which: str, object_name: str) -> Float[Tensor, "k"]:
        """Compute the configured ``initial`` or ``target`` psi of an object, float64."""
        ...

    def closed(self, object_name: str) -> Bool[Tensor, "k"]:
        """Find the strata of an object from which nothing is drawn."""
        ...

    def psi_of(
        self, p: Float[Tensor, "*n k"], closed: Bool[Tensor, "*n k"] | None = None
    ) -> Float[Tensor, "*n k"]:
        """Map probabilities of bins, or weights of lights, to psi; nothing is drawn from ``closed`` strata."""
        ...

    def p_of(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Map psi to probabilities of bins, or weights of lights."""
        ...

    def log_slopes(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Compute log w; it is 0 for lights.

        A derivative with respect to psi, divided by w, is the one with respect to p, up to a constant.
        """
        ...

    def project(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Find the nearest psi that meets the factor's constraint."""
        ...

    def moved(
        self, psi: Float[Tensor, "*n k"], change: Float[Tensor, "*n k"], keep: float
    ) -> Float[Tensor, "*n k"]:
        """Find the psi whose p is nearest to p + ``change`` while each bin keeps at least a fraction ``keep`` of p."""
        ...

    def stratum_of(self, draw: SceneDraw) -> Int[Tensor, "n"]:
        """Find the stratum of each draw."""
        ...


@validated
@dataclass(frozen=True)
class BinnedFactor:
    """A factor of one coordinate, whose part of psi has the logits of ``bins`` equal bins of [``low``, ``high``].

    Args:
        name: name of the factor, and of the configuration node ``parameter.<name>``.
        coordinate: the coordinate that is drawn; angles are in radians, distances in the distribution's unit.
        geometric: bins have equal ratios of their ends instead of equal widths; ``low`` must be positive.
        periodic: ``low`` and ``high`` are the same angle.
        temperature: tau of the Gumbel-softmax (Eq. 4; the paper: 0.1).
        bin_mean: ``linear`` is the paper's sum_i y_i B_i, ``circular`` its counterpart on the circle.
        floor: smallest probability of a bin.
        configured: initial and target distributions by object.

    Raises:
        ValueError: an argument is out of its range; the message names its key and value.
    """

    update: ClassVar[str] = "update"
    name: str
    coordinate: Coordinate
    bins: PositiveInt
    low: float
    high: float
    geometric: bool = False
    periodic: bool = False
    temperature: Positive = 0.1
    bin_mean: Literal["linear", "circular"] = "linear"
    floor: Floor = 0.005
    configured: ConfiguredDistributions = ConfiguredDistributions()

    def __post_init__(self) -> None:
        where = f"parameter.{self.name}"
        if self.bin_mean == "circular" and not self.periodic:
            raise ValueError(f"{where}.bin_mean: circular is for a full circle, want linear")
        if not self.floor < 1.0 / self.bins:
            raise ValueError(
                f"{where}.floor: want less than 1/{self.bins} for {self.bins} bins, got {self.floor}"
            )
        if not self.low < self.high or (self.geometric and not self.low > 0.0):
            both = " and both positive" if self.geometric else ""
            raise ValueError(
                f"{where}: want a range of bins with low < high{both}, got [{self.low}, {self.high}]"
            )
        for name in (*(self.configured.biased or {}), ""):  # "": objects that are not named
            for which in ("initial", "target"):
                self.probabilities(which, name)
        for name in self.configured.closed or {}:
            for which in ("initial", "target"):
                if not bool(self.probabilities(which, name)[~self.closed(name)].any()):
                    raise ValueError(
                        f"{where}.{which} of {name}: want bins that photographs show, got a distribution that is all "
                        "in other bins; change it, or set parameter.pose.uncovered=render"
                    )

    @property
    def drawn(self) -> dict[str, Any]:
        """The settings on which hard draws at given probabilities depend: neither relaxation nor floor."""
        names = ("coordinate", "bins", "low", "high", "geometric", "periodic")
        return {name: getattr(self, name) for name in names}

    @property
    def size(self) -> int:
        """Number of psi's entries for each object."""
        return self.bins

    @property
    def lights(self) -> int:
        """0: this factor does not change the light."""
        return 0

    def probabilities(self, which: str, object_name: str) -> Float[Tensor, "k"]:
        """Compute the configured ``initial`` or ``target`` distribution of one object."""
        where = f"parameter.{self.name}.{which}" + (f" of {object_name}" if object_name else "")
        return distribution(self.configured.of(which, object_name), self.bins, where)

    def psi(self, which: str, object_name: str) -> Float[Tensor, "k"]:
        """Compute the logits of ``probabilities``, with nothing on closed bins."""
        return self.psi_of(self.probabilities(which, object_name), self.closed(object_name))

    def closed(self, object_name: str) -> Bool[Tensor, "k"]:
        """Find the bins from which nothing is drawn."""
        bins = (self.configured.closed or {}).get(object_name, ())
        return torch.tensor([number + 1 in bins for number in range(self.bins)])

    def psi_of(
        self, p: Float[Tensor, "*n k"], closed: Bool[Tensor, "*n k"] | None = None
    ) -> Float[Tensor, "*n k"]:
        """Compute the logits that give the probabilities ``p``; nothing is drawn from ``closed`` bins."""
        return binned.logits(p, self.floor, closed)

    def p_of(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Compute the probabilities of the bins."""
        return self.log_probabilities(psi).exp()

    def log_probabilities(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Compute log p of the bins, with the floor."""
        return binned.log_probabilities(psi, self.floor)

    def log_slopes(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Compute log (p - floor)."""
        return binned.log_slopes(psi, self.floor)

    def project(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Raise logits that lie too far below the largest, see ``bins.bounded``."""
        return binned.bounded(psi, self.floor)

    def moved(
        self, psi: Float[Tensor, "*n k"], change: Float[Tensor, "*n k"], keep: float
    ) -> Float[Tensor, "*n k"]:
        """Compute logits of the probabilities nearest to p + ``change``.

        No probability is lower than ``project`` allows, or than the fraction ``keep`` of its present value.
        """
        p, closed = self.p_of(psi), binned.is_closed(psi)
        return binned.logits(binned.nearest(p + change, self.floor, keep * p, closed), self.floor, closed)

    def stratum_of(self, draw: SceneDraw) -> Int[Tensor, "n"]:
        """Find the bin of each draw's coordinate, which for a relaxed draw is not always the bin that was drawn."""
        return self.bin_of(getattr(draw, self.coordinate))

    def hard(self, psi: Float[Tensor, "k"], noise: BinNoise) -> Int[Tensor, "n"]:
        """Draw bins exactly by the Gumbel-max trick, balanced if the noise has an offset; not differentiable."""
        log_p = self.log_probabilities(psi.detach())
        if noise.offset is None:
            return (log_p + noise.gumbel).argmax(-1)
        return binned.balanced(log_p, noise.gumbel, noise.offset)

    def at(self, bins: Int[Tensor, "n"], within: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Compute the coordinate at the fraction ``within`` of each given bin."""
        return self._place(self._centres(within)[bins], within)

    def relaxed(
        self, psi: Float[Tensor, "k"], noise: BinNoise, within: Float[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Draw the coordinate differentiably in psi (approximate bin centre plus uniform offset, Tool 1).

        Also returns the bins of the hard draws under the same noise. At small tau, nearly all of the derivative comes
        from the few draws near a tie between two bins.
        """
        log_p = self.log_probabilities(psi)
        weights = binned.gumbel_softmax(log_p, noise.gumbel, self.temperature)
        mean = binned.circular_mean if self.bin_mean == "circular" else binned.linear_mean
        centre = mean(weights, self._centres(noise.gumbel))
        return self._place(centre, within), (log_p.detach() + noise.gumbel).argmax(-1)

    def bin_of(self, values: Float[Tensor, "n"]) -> Int[Tensor, "n"]:
        """Find the bin of each value. Values outside a range that is not periodic belong to the nearest end bin."""
        low, high = self._ends
        at = values.log() if self.geometric else values
        if self.periodic:
            return binned.nearest_bin(at, self.bins, low, high)
        return ((at.detach() - low) / (high - low) * self.bins).long().clamp(0, self.bins - 1)

    @property
    def _ends(self) -> tuple[float, float]:
        return (math.log(self.low), math.log(self.high)) if self.geometric else (self.low, self.high)

    def _centres(self, like: Tensor) -> Float[Tensor, "k"]:
        return binned.centres(self.bins, *self._ends, like)

    def _place(self, centre: Float[Tensor, "n"], within: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        low, high = self._ends
        placed = centre + (within - 0.5) * ((high - low) / self.bins)
        return placed.exp() if self.geometric else placed
