"""The illumination parameter: psi are deterministic weights of anchor lights that add up to 1.

An object's images share one light, whose code is l = sum_i psi_i l_i with sum_i psi_i = 1 (paper, Sec. 3.2), and psi
takes projected gradient steps. Estimators that need a density draw the weights from a Gaussian around psi instead, and
score the draw before its projection, because the projected draw has no density.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, cast

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.parameter.distributions import (
    Biased,
    Specification,
    distribution,
    project_simplex,
    project_sum,
)
from neural_sim.parameter.factor import ConfiguredDistributions, Gap
from neural_sim.ranges import Positive, validated
from neural_sim.types import SceneDraw

Constraint = Literal["simplex", "affine"]


@dataclass(frozen=True)
class GaussianDraw:
    """Draws around psi: ``log_prob`` scores ``unprojected``; ``weights``, their projections, are rendered."""

    unprojected: Float[Tensor, "n k"]
    weights: Float[Tensor, "n k"]


@validated
@dataclass(frozen=True)
class Illumination:
    """Weights of ``anchors`` lights, configured for each object.

    Args:
        anchors: k, the number of anchor lights.
        constraint: ``simplex``: weights add up to 1 and none is below 0; ``affine``: they add up to 1.
        deviation: standard deviation of each weight in Gaussian draws.
        initial, target: weights of objects that are not named in ``biased``: ``uniform``, ``{dominant: b}``,
            ``{modes: [b, ...]}`` (see ``distributions.distribution``) or k numbers that add up to 1.
        biased, gap: see ``ConfiguredDistributions``.

    Raises:
        ValueError: an argument is out of its range; the message names its key and value.
    """

    update: ClassVar[str] = "light_update"
    anchors: Annotated[int, Ge(2), Le(1000)] = 6
    constraint: Constraint = "simplex"
    deviation: Positive = 0.1
    initial: Specification = "uniform"
    target: Specification = "uniform"
    biased: Biased | None = None
    gap: Gap = "disjoint"

    def __post_init__(self) -> None:
        for name in ("", *(self.biased or {})):  # a bad specification is refused before any stage runs
            self.psi("initial", name)
            self.psi("target", name)

    @property
    def name(self) -> str:
        """The factor's name."""
        return "illumination"

    @property
    def drawn(self) -> dict[str, Any]:
        """The settings on which images at given weights depend."""
        return {"anchors": self.anchors}

    @property
    def size(self) -> int:
        """Number of psi's entries for each object."""
        return self.anchors

    @property
    def lights(self) -> int:
        """Number of anchor lights."""
        return self.anchors

    @property
    def factors(self) -> tuple[Illumination, ...]:
        """This parameter, which is its own only factor."""
        return (self,)

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Empty: an illumination draws no coordinates."""
        return {}

    @property
    def configured(self) -> ConfiguredDistributions:
        """The configured weights, by object."""
        return ConfiguredDistributions(self.initial, self.target, self.biased, self.gap)

    def psi(self, which: str, object_name: str) -> Float[Tensor, "k"]:
        """Compute the configured ``initial`` or ``target`` weights of one object, float64; psi is these weights."""
        specification = self.configured.of(which, object_name)
        where = f"parameter.illumination.{which}" + (f" of {object_name}" if object_name else "")
        numbers = isinstance(specification, Sequence) and not isinstance(specification, str)
        if self.constraint == "affine" and numbers:
            return _affine_numbers(cast(Sequence[float], specification), self.anchors, where)
        return distribution(specification, self.anchors, where)

    def closed(self, object_name: str) -> Bool[Tensor, "k"]:
        """Return False for every light: none can be closed."""
        return torch.zeros(self.anchors, dtype=torch.bool)

    def psi_of(
        self, p: Float[Tensor, "*n k"], closed: Bool[Tensor, "*n k"] | None = None
    ) -> Float[Tensor, "*n k"]:
        """Return ``p``, because psi consists of the weights themselves."""
        return p

    def p_of(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Return psi, which consists of the weights themselves."""
        return psi

    def log_slopes(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Return 0, because derivatives with respect to psi are derivatives with respect to the weights."""
        return torch.zeros_like(psi)

    def project(self, psi: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
        """Find the nearest weights that meet the constraint.

        Raises:
            ValueError: some values are not finite.
        """
        return project_simplex(psi) if self.constraint == "simplex" else project_sum(psi)

    def moved(
        self, psi: Float[Tensor, "*n k"], change: Float[Tensor, "*n k"], keep: float
    ) -> Float[Tensor, "*n k"]:
        """Find the weights nearest to psi + ``change`` that meet the constraint.

        ``keep`` is ignored: it stops bins from losing their images, but weights are not shares of images.
        """
        return self.project(psi + change)

    def stratum_of(self, draw: SceneDraw) -> Int[Tensor, "n"]:
        """Find the anchor light with the largest weight.

        Raises:
            ValueError: the draws are under the fixed light.
        """
        if draw.weights is None:
            raise ValueError("parameter.illumination: want draws under weighted lights, got the fixed light")
        return draw.weights.argmax(-1)

    def draw(self, psi: Float[Tensor, "k"], count: int) -> Float[Tensor, "n k"]:
        """Repeat psi for every image, differentiably."""
        return psi.expand(count, -1)

    def explore(self, psi: Float[Tensor, "k"], noise: Float[Tensor, "n k"]) -> GaussianDraw:
        """Draw from N(psi, deviation^2 I) using standard normal ``noise``, and project; detached from psi."""
        unprojected = psi.detach() + self.deviation * noise
        return GaussianDraw(unprojected, self.project(unprojected))

    def log_prob(self, psi: Float[Tensor, "k"], unprojected: Float[Tensor, "n k"]) -> Float[Tensor, "n"]:
        """Compute the log density of draws before their projection; its gradient is (u - psi) / deviation^2."""
        scaled = (unprojected.detach() - psi) / self.deviation
        constant = self.anchors * (math.log(self.deviation) + 0.5 * math.log(2.0 * math.pi))
        return -0.5 * scaled.square().sum(-1) - constant


def _affine_numbers(values: Sequence[float], anchors: int, where: str) -> Float[Tensor, "k"]:
    weights = torch.tensor([float(value) for value in values], dtype=torch.float64)
    if len(weights) != anchors:
        raise ValueError(f"{where}: want {anchors} numbers, got {len(weights)}")
    if not bool(torch.isfinite(weights).all()) or abs(float(weights.sum()) - 1.0) > 1e-6:
        raise ValueError(f"{where}: want finite weights that add up to 1, got {weights.tolist()}")  # pyright: ignore[reportUnknownMemberType]
    return weights
