"""What an outer loop leaves: one record an iteration, and the distributions it went through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neural_sim.outer.certificate import Certificate
from neural_sim.outer.cost import Cost
from neural_sim.outer.steps import Verdict


@dataclass(frozen=True)
class IterationRecord:
    """What one outer iteration did; probabilities, by factor and object, are those the images were drawn from, before
    the step.

    ``images`` are the labelled images made in it, probes included, ``detector_steps`` the optimiser steps and
    ``products`` the Hessian products spent. ``seconds`` are by phase and by the clock on the wall, ``cpu_seconds``
    those that all processor cores together worked, which other processes on the machine disturb less.
    ``certificate`` is None for methods without a hypergradient, and where the last iteration took none. ``scores`` of
    the classes are those of the loop's objective, more is better; ``verdicts`` are of the objects whose last step was
    checked.
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
    scores: list[float]
    verdicts: dict[str, Verdict]
    seconds: dict[str, float]
    cpu_seconds: float


def cost_of(record: IterationRecord) -> Cost:
    """Of one iteration. Phases ``hypergradient_*`` are parts of ``hypergradient``, which counts them already."""
    phases = record.seconds.items()
    seconds = sum(spent for phase, spent in phases if not phase.startswith("hypergradient_"))
    return Cost(record.images, record.detector_steps, record.products, seconds, record.cpu_seconds)


def record_of(stored: Mapping[str, Any]) -> IterationRecord:
    """A record from what ``dataclasses.asdict`` made of one."""
    certificate = stored["certificate"]
    return IterationRecord(
        **{
            **stored,
            "certificate": certificate and Certificate(**certificate),
            "verdicts": {name: Verdict(**verdict) for name, verdict in stored["verdicts"].items()},
        }
    )


@dataclass(frozen=True)
class LearnedPsi:
    """The loop's outcome. ``trajectory`` is what the method would report before the first iteration and after each; a
    checked step is in it from the training on that accepted it. ``before`` is what was spent before the first: on the
    warm start, whose backbone every loop has."""

    trajectory: Float[Tensor, "iterations+1 objects K"]
    records: list[IterationRecord]
    before: Cost = field(default_factory=Cost)

    def cost(self, iterations: int) -> Cost:
        """What was spent up to the end of so many iterations; nothing before the first, whose psi is given."""
        return sum(
            (cost_of(record) for record in self.records[:iterations]), self.before if iterations else Cost()
        )

    @property
    def last(self) -> Float[Tensor, "objects K"]:
        """What the method reports."""
        return self.trajectory[-1]
