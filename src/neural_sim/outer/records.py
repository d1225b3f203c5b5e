"""What an outer loop leaves: one record an iteration, and the distributions it went through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neural_sim.outer.certificate import Certificate


@dataclass(frozen=True)
class Cost:
    """What was spent: labelled images made, optimiser steps of detectors, Hessian products, seconds on the wall clock
    and seconds of all processor cores together."""

    images: int = 0
    detector_steps: int = 0
    products: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        return Cost(
            self.images + other.images,
            self.detector_steps + other.detector_steps,
            self.products + other.products,
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
        )

    @staticmethod
    def of(records: Sequence[Mapping[str, Any]]) -> Cost:
        """The sum over iteration records (as dictionaries). Phases ``hypergradient_*`` are parts of ``hypergradient``,
        which counts them already."""
        total = Cost()
        for record in records:
            phases = record["seconds"].items()
            seconds = sum(spent for phase, spent in phases if not phase.startswith("hypergradient_"))
            counts = (record[key] for key in ("images", "detector_steps", "products"))
            total += Cost(*counts, seconds=seconds, cpu_seconds=record["cpu_seconds"])
        return total


@dataclass(frozen=True)
class IterationRecord:
    """What one outer iteration did; probabilities, by factor and object, are those the images were drawn from, before
    the step.

    ``images`` are the labelled images made in it, probes included, ``detector_steps`` the optimiser steps and
    ``products`` the Hessian products spent. ``seconds`` are by phase and by the clock on the wall, ``cpu_seconds``
    those that all processor cores together worked, which other processes on the machine disturb less.
    ``certificate`` is None for methods without a hypergradient.
    """

    probabilities: dict[str, list[list[float]]]
    entropies: dict[str, list[float]]
    gradient_norms: list[float]
    validation_loss: float
    training_loss: float
    certificate: Certificate | None
    images: int
    detector_steps: int
    products: int
    images_without_box: int
    seconds: dict[str, float]
    cpu_seconds: float


@dataclass(frozen=True)
class LearnedPsi:
    """The loop's outcome. ``trajectory`` is psi before the first iteration and after each: its last is what the
    method reports."""

    trajectory: Float[Tensor, "iterations+1 objects K"]
    records: list[IterationRecord]

    @property
    def last(self) -> Float[Tensor, "objects K"]:
        """What the method reports."""
        return self.trajectory[-1]
