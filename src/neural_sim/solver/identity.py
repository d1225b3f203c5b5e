"""The inverse taken as a multiple of the identity: the one-step choice T1-T2 (Luketina et al. 2016)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from neural_sim.solver.base import Iterate, LinearSolver, System
from neural_sim.solver.solution import Status


@dataclass(frozen=True)
class Identity(LinearSolver):
    """``x = scale b``. One product is spent on the residual."""

    scale: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale != 0.0):
            raise ValueError(f"identity: scale must be finite and not 0, got {self.scale}")

    def iterate(self, system: System) -> Iterate:
        return Iterate(self.scale * system.rhs, Status.APPROXIMATE, 0)
