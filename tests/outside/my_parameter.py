"""A parameter from outside the package: the turn about the vertical, within a part of the circle."""

import math
from dataclasses import dataclass
from typing import Annotated

from neural_sim.parameter.factor import BinnedFactor, ConfiguredDistributions
from neural_sim.ranges import Ascending, PositiveInt, validated


@validated
@dataclass(frozen=True)
class Turn:
    bins: PositiveInt = 3
    range_deg: Annotated[tuple[float, float], Ascending(strictly=True)] = (-60.0, 60.0)
    target: str | dict | list = "uniform"

    @property
    def factors(self):
        low, high = (math.radians(degrees) for degrees in self.range_deg)
        return (
            BinnedFactor(
                "turn", "rho", self.bins, low, high, configured=ConfiguredDistributions(target=self.target)
            ),
        )

    @property
    def ranges(self):
        return {"phi": (math.radians(60.0), math.radians(120.0))}
