"""A parameter from outside the package: the turn about the vertical, within a part of the circle."""

import math
from dataclasses import dataclass

from neural_sim.parameter.factor import BinnedFactor, ConfiguredDistributions


@dataclass(frozen=True)
class Turn:
    bins: int = 3
    range_deg: tuple[float, float] = (-60.0, 60.0)
    target: str | dict | list = "uniform"

    def __post_init__(self):
        if not self.range_deg[0] < self.range_deg[1]:
            raise ValueError(f"parameter.turn.range_deg must be ordered, got {list(self.range_deg)}")

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
