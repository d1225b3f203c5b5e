"""What an outer loop leaves: one record an iteration, and the distributions it went through."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from neural_sim.outer.certificate import Certificate


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
