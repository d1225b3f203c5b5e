"""The zoom parameter: how large objects appear, set by the camera's distance or by its focal length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from neural_sim.parameter.distributions import Biased, Specification
from neural_sim.parameter.factor import BinnedFactor, ConfiguredDistributions, Coordinate, Floor, Gap
from neural_sim.parameter.unlearned import NEAREST, Unit
from neural_sim.ranges import Ascending, Positive, PositiveInt, validated

By = Literal["distance", "focal_length"]


@validated
@dataclass(frozen=True)
class Zoom:
    """A zoom in bins of equal ratio, which do not wrap: image sizes of neighbours have the ratio (far / near)^(1/k).

    Args:
        bins: k, the number of bins.
        by: ``distance`` moves the camera; ``focal_length`` magnifies the image from where the camera stands, without
            changing the perspective.
        range: nearest and farthest distance; or smallest and largest focal length in units of the camera's own. Bin 1
            is the nearest, or the smallest magnification.
        unit: unit of the distances, ``radii`` of each object or ``metres``; has no effect on a focal length.
        temperature, floor: see ``BinnedFactor``.
        initial, target, biased, gap: see ``ConfiguredDistributions``.

    Raises:
        ValueError: an argument is out of its range; the message names its key and value.
    """

    bins: PositiveInt = 4
    by: By = "distance"
    range: Annotated[tuple[Positive, Positive], Ascending(strictly=True)] = (2.2, 8.5)
    unit: Unit = "radii"
    temperature: Positive = 0.1
    floor: Floor = 0.005
    initial: Specification = "uniform"
    target: Specification = "uniform"
    biased: Biased | None = None
    gap: Gap = "disjoint"

    def __post_init__(self) -> None:
        if self.by == "distance" and self.unit == "radii" and not self.range[0] > NEAREST:
            raise ValueError(
                f"parameter.zoom.range: want more than {NEAREST} object radii, got {list(self.range)}"
            )
        _ = self.factors  # raises if their distributions are invalid

    @property
    def factors(self) -> tuple[BinnedFactor, ...]:
        """The learned coordinate, as one factor."""
        near, far = self.range
        coordinate: Coordinate = "distance" if self.by == "distance" else "magnification"
        configured = ConfiguredDistributions(self.initial, self.target, self.biased, self.gap)
        return (
            BinnedFactor(
                "zoom", coordinate, self.bins, near, far, geometric=True, temperature=self.temperature,
                floor=self.floor, configured=configured,
            ),
        )  # fmt: skip

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """Empty: a zoom draws no other coordinates."""
        return {}
