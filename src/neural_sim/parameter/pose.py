"""The pose parameter: bins of the angle over the poles, of the turn about the vertical, or of both."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from annotated_types import Gt, Le

from neural_sim.parameter.distributions import Biased, Specification
from neural_sim.parameter.factor import BinnedFactor, ConfiguredDistributions, Floor, Gap
from neural_sim.ranges import Ascending, Matching, Positive, PositiveInt, validated

Axis = Literal["polar", "azimuth", "both"]
OTHER_RANGE_DEG: Mapping[Axis, tuple[float, float]] = {"azimuth": (45.0, 135.0), "both": (-45.0, 45.0)}
"""Default of ``other_range_deg`` by axis; with ``polar``, rho has the range of ``unlearned`` instead."""
Range = Annotated[
    tuple[float, float], Ascending(), Matching(lambda ends: ends[1] - ends[0] <= 360.0, "at most a circle")
]


@validated
@dataclass(frozen=True)
class Pose:
    """The angles of the camera's pose that are learned, and their bins.

    Args:
        bins: k, the number of equal bins of the full circle.
        axis: ``polar`` bins phi, the angle along the great circle through the poles, with rho uniform in
            ``other_range_deg``; ``azimuth`` bins rho, the turn about the vertical, with phi uniform in
            ``other_range_deg``; ``both`` bins phi's full circle and rho's ``other_range_deg``, as two factors ``pose``
            and ``turn``. If both angles cover the full circle (as the paper's rho does), (phi, rho) and
            (360 - phi, rho + 180) are the same camera position and direction, with the camera upside down in one of
            them: bins i and k + 1 - i show an object from the same sides, upright and upside down.
        other_bins: number of rho's bins with ``both``; they do not wrap.
        other_range_deg: range of the angle that ``bins`` does not divide. null: for rho, ``unlearned.rho_deg``, or
            [-45, 45] with ``both``; for phi, [45, 135].
        temperature, bin_mean, floor: see ``BinnedFactor``; ``bin_mean`` applies to the full circle.
        uncovered: what to do with bins that photographs of the object do not cover: ``leave_out`` (their p is 0) or
            ``render``.
        covered_within_deg: a photograph is near a pose if their directions differ by at most this angle.
        initial, target, biased, gap: see ``ConfiguredDistributions``. With ``both``, {phi: ..., rho: ...} gives each
            angle a distribution; a single distribution applies to phi, and rho is uniform.

    Raises:
        ValueError: an argument is out of its range; the message names its key and value.
    """

    bins: PositiveInt = 8
    axis: Axis = "polar"
    other_bins: PositiveInt = 4
    other_range_deg: Range | None = None
    temperature: Positive = 0.1
    bin_mean: Literal["linear", "circular"] = "circular"
    floor: Floor = 0.005
    initial: Specification = "uniform"
    target: Specification = "uniform"
    biased: Biased | None = None
    gap: Gap = "disjoint"
    uncovered: Literal["leave_out", "render"] = "leave_out"
    covered_within_deg: Annotated[float, Gt(0), Le(180)] = 30.0

    def __post_init__(self) -> None:
        _ = self.factors  # raises if their distributions are invalid

    @property
    def _other_range_deg(self) -> tuple[float, float] | None:
        return OTHER_RANGE_DEG.get(self.axis) if self.other_range_deg is None else self.other_range_deg

    @property
    def factors(self) -> tuple[BinnedFactor, ...]:
        """One factor for each learned angle."""
        configured = ConfiguredDistributions(self.initial, self.target, self.biased, self.gap)
        circle = BinnedFactor(
            "pose", "rho" if self.axis == "azimuth" else "phi", self.bins, 0.0, 2.0 * math.pi, periodic=True,
            temperature=self.temperature, bin_mean=self.bin_mean, floor=self.floor,
            configured=_angle(configured, "phi") if self.axis == "both" else configured,
        )  # fmt: skip
        if self.axis != "both" or self._other_range_deg is None:
            return (circle,)
        low, high = (math.radians(degrees) for degrees in self._other_range_deg)
        turn = replace(
            circle, name="turn", coordinate="rho", bins=self.other_bins, low=low, high=high, periodic=False,
            bin_mean="linear", configured=_angle(configured, "rho"),
        )  # fmt: skip
        return circle, turn

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Uniform ranges, in radians, of coordinates that are drawn but not learned."""
        if self.axis == "both" or self._other_range_deg is None:
            return {}
        low, high = (math.radians(degrees) for degrees in self._other_range_deg)
        return {"phi" if self.axis == "azimuth" else "rho": (low, high)}


def _angle(configured: ConfiguredDistributions, angle: str) -> ConfiguredDistributions:
    """Pick one angle's distributions from those configured for both."""

    def part(specification: Specification) -> Specification:
        if isinstance(specification, Mapping) and set(specification) <= {"phi", "rho"} and specification:
            return specification.get(angle, "uniform")  # pyright: ignore[reportReturnType]
        return specification if angle == "phi" else "uniform"

    biased: Biased = {
        name: {which: part(specification) for which, specification in own.items()}
        for name, own in (configured.biased or {}).items()
    }
    return ConfiguredDistributions(part(configured.initial), part(configured.target), biased, configured.gap)
