"""The pose parameter: a binned angle with a learned distribution, and a second angle drawn uniformly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.parameter import bins as binned
from neural_sim.parameter.distributions import Specification, distribution
from neural_sim.types import SceneDraw

Relaxation = Literal["gumbel_softmax", "straight_through", "gumbel_rao"]
"""How a draw depends on psi, see :meth:`Pose.relaxed`."""


@dataclass(frozen=True)
class PoseNoise:
    """All randomness of n draws, made once and replayed by every pass (paper, Tool 2).

    ``gumbel`` picks the bin; ``within``, ``other`` and ``distance`` are uniform in [0, 1). ``exponential`` (for
    ``gumbel_rao`` only) makes other Gumbel noise that would have picked the same bin.
    """

    gumbel: Float[Tensor, "n k"]
    within: Float[Tensor, "n"]
    other: Float[Tensor, "n"]
    distance: Float[Tensor, "n"]
    exponential: Float[Tensor, "n draws k"] | None = None

    def __len__(self) -> int:
        return self.within.shape[0]


@dataclass(frozen=True)
class Pose:
    """p_psi over camera poses: log p over ``bins`` bins of one angle, everything else uniform.

    Args:
        bins: k, the number of equal bins of the binned angle's full circle.
        axis: ``polar`` bins phi, the great circle through the poles, with rho uniform in ``other_range_deg``;
            ``azimuth`` bins rho, the turn about the vertical, with phi uniform in ``other_range_deg``.
        other_range_deg: range of the angle that is not binned, in degrees.
        distance_range: uniform range of the camera's distance, in object radii.
        temperature: tau of the Gumbel-softmax (Eq. 4; the paper: 0.1).
        bin_mean: ``linear`` is the paper's sum_i y_i B_i, ``circular`` its counterpart on the circle.
        floor: smallest probability of a bin.
        initial, target: distributions of objects not named in ``biased``.
        biased: object name -> {initial: ..., target: ...}, see :func:`distributions.distribution`.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    bins: int = 8
    axis: str = "polar"
    other_range_deg: tuple[float, float] = (-45.0, 45.0)
    distance_range: tuple[float, float] = (2.4, 4.0)
    temperature: float = 0.1
    bin_mean: str = "circular"
    floor: float = 0.005
    initial: Specification = "uniform"
    target: Specification = "uniform"
    biased: Mapping[str, Mapping[str, Specification]] | None = None

    def __post_init__(self) -> None:
        if self.bins < 1:
            raise ValueError(f"parameter.pose.bins must be at least 1, got {self.bins}")
        if self.axis not in ("polar", "azimuth"):
            raise ValueError(f"parameter.pose.axis must be polar or azimuth, got {self.axis!r}")
        if self.bin_mean not in ("linear", "circular"):
            raise ValueError(f"parameter.pose.bin_mean must be linear or circular, got {self.bin_mean!r}")
        if not self.temperature > 0.0:
            raise ValueError(f"parameter.pose.temperature must be positive, got {self.temperature}")
        if not 0.0 <= self.floor < 1.0 / self.bins:
            raise ValueError(f"parameter.pose.floor must lie in [0, 1/bins), got {self.floor}")
        low, high = self.distance_range
        if not 1.0 < low <= high:
            raise ValueError(
                f"parameter.pose.distance_range must be ordered and above 1 radius, got {low, high}"
            )
        if self.other_range_deg[0] > self.other_range_deg[1]:
            raise ValueError(f"parameter.pose.other_range_deg must be ordered, got {self.other_range_deg}")

    def probabilities(self, which: str, object_name: str) -> Float[Tensor, "k"]:
        """The configured ``initial`` or ``target`` distribution of one object."""
        specification = self.initial if which == "initial" else self.target
        if self.biased and object_name in self.biased:
            specification = self.biased[object_name].get(which, specification)
        return distribution(specification, self.bins, f"parameter.pose.{which} of {object_name}")

    def logits(self, probabilities: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """psi that gives ``probabilities``."""
        return binned.logits(probabilities, self.floor)

    def log_probabilities(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """log p over the bins, floored."""
        return binned.log_probabilities(psi, self.floor)

    def log_prob(self, psi: Float[Tensor, "k"], bins: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """log-probability of drawn bins (for REINFORCE)."""
        return self.log_probabilities(psi)[bins]

    def draw_noise(
        self,
        n: int,
        generator: torch.Generator,
        dtype: torch.dtype = torch.float32,
        antithetic: bool = False,
        conditional: int = 0,
    ) -> PoseNoise:
        """Randomness of n draws; independent of psi.

        ``antithetic``: Gumbel noise in pairs from uniforms u and 1 - u. ``conditional``: draws of the noise given the
        bin, for ``gumbel_rao``. Raises ``ValueError`` for an odd number of antithetic draws.
        """
        noise = binned.gumbel((n, self.bins), generator, dtype, antithetic)
        uniform = torch.rand((3, n), generator=generator, dtype=torch.float64).to(dtype)
        exponential = None
        if conditional:
            empty = torch.empty(n, conditional, self.bins, dtype=torch.float64)
            exponential = empty.exponential_(generator=generator).clamp_min(1e-30).to(dtype)
        return PoseNoise(noise, uniform[0], uniform[1], uniform[2], exponential)

    def hard(self, psi: Float[Tensor, "k"], noise: PoseNoise) -> SceneDraw:
        """Exact samples of p_psi by the Gumbel-max trick; no derivative reaches psi."""
        chosen = (self.log_probabilities(psi.detach()) + noise.gumbel).argmax(-1)
        return self.at_bins(chosen, noise)

    def at_bins(self, bins: Int[Tensor, "n"], noise: PoseNoise) -> SceneDraw:
        """Samples in given bins, uniform within each."""
        return self._place(self._centres(noise.within)[bins], bins, noise)

    def relaxed(
        self, psi: Float[Tensor, "k"], noise: PoseNoise, relaxation: Relaxation = "gumbel_softmax"
    ) -> SceneDraw:
        """Samples that are differentiable in psi: approximate bin centre plus uniform offset (Tool 1).

        ``gumbel_softmax`` is the paper's: at small tau most draws lie in one bin and carry next to no derivative; the
        few near a tie carry it all. ``straight_through`` samples exactly from p_psi, as ``hard`` does, and takes the
        relaxed draw's derivative there (Bengio et al. 2013; Jang et al. 2017); its mean is the derivative of no
        expectation in general. ``gumbel_rao`` has that same mean at lower variance: the relaxed derivative is averaged
        over noise that would have chosen the same bin (Paulus et al. 2021).

        Raises:
            ValueError: ``gumbel_rao`` without the noise for it.
        """
        log_p = self.log_probabilities(psi)
        given = noise.gumbel
        bin_centres = self._centres(given)
        mean = binned.circular_mean if self.bin_mean == "circular" else binned.linear_mean
        chosen = (log_p.detach() + given).argmax(-1)
        if relaxation == "gumbel_rao":
            if noise.exponential is None:
                raise ValueError("pose: gumbel_rao wants noise drawn with conditional >= 1, got none")
            given = binned.conditional_gumbel(log_p.detach(), chosen, noise.exponential)
        relaxed = mean(binned.gumbel_softmax(log_p, given, self.temperature), bin_centres)
        if relaxation == "gumbel_softmax":
            return self._place(relaxed, chosen, noise)
        if relaxation == "gumbel_rao":
            relaxed = relaxed.mean(-1)
        return self._place(bin_centres[chosen] + (relaxed - relaxed.detach()), chosen, noise)

    def bin_of(self, draw: SceneDraw) -> Int[Tensor, "n"]:
        """The bin each pose of ``draw`` lies in, whatever bin it was drawn for."""
        angle = draw.phi if self.axis == "polar" else draw.rho
        return binned.nearest_bin(angle, self.bins, 0.0, 2.0 * math.pi)

    def _centres(self, like: Tensor) -> Float[Tensor, "k"]:
        return binned.centres(self.bins, 0.0, 2.0 * math.pi, like)

    def _place(self, centre: Float[Tensor, "n"], bins: Int[Tensor, "n"], noise: PoseNoise) -> SceneDraw:
        binned_angle = centre + (noise.within - 0.5) * (2.0 * math.pi / self.bins)
        low, high = (math.radians(degrees) for degrees in self.other_range_deg)
        other = low + (high - low) * noise.other
        near, far = self.distance_range
        distance = near + (far - near) * noise.distance
        phi, rho = (binned_angle, other) if self.axis == "polar" else (other, binned_angle)
        return SceneDraw(phi, rho, distance, bins)
