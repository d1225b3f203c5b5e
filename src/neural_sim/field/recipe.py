"""A field's kind, its fitting and its budget in one configured object, from which each object's field is fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from neural_sim.field.base import RadianceField
from neural_sim.field.objective import Fitting
from neural_sim.field.training import fit_field
from neural_sim.types import PosedViews


@dataclass(frozen=True)
class FieldRecipe:
    """How to fit a field to views.

    Args:
        field: makes a new field.
        fitting: makes the fitting of a field.
        steps: optimiser steps, the budget.
        seed: of new weights and the order of rays; not the run's seed, so that runs share fields.
    """

    field: Callable[[], RadianceField]
    fitting: Callable[[RadianceField], Fitting]
    steps: int = 1000
    final_rate: float = 0.1
    score_every: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"field.steps must be at least 1, got {self.steps}")

    def fit(
        self, views: PosedViews, held_out: int, device: torch.device
    ) -> tuple[RadianceField, list[dict[str, Any]]]:
        """The fitted field, and its scores on the last ``held_out`` views against steps and seconds."""
        placed = views.to(device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)  # layers of a new field draw from the global generator
            fitting = self.fitting(self.field().to(device))
        generator = torch.Generator().manual_seed(self.seed)
        return fit_field(
            placed, fitting, generator, steps=self.steps, held_out=held_out,
            final_rate=self.final_rate, score_every=self.score_every,
        )  # fmt: skip
