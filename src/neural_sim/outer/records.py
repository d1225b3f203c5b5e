"""What the psi loop leaves: one record an iteration, and the distributions it found."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from neural_sim.outer.certificate import Certificate


@dataclass(frozen=True)
class IterationRecord:
    """What one outer iteration did; probabilities, by factor and object, are those the images were drawn from, before
    the step."""

    probabilities: dict[str, list[list[float]]]
    entropies: dict[str, list[float]]
    gradient_norms: list[float]
    validation_loss: float
    training_loss: float
    certificate: Certificate
    images_without_box: int
    seconds: dict[str, float]


@dataclass(frozen=True)
class LearnedPsi:
    """The loop's outcome. ``last`` is what the method reports; ``best`` had the lowest validation loss."""

    last: Float[Tensor, "objects K"]
    best: Float[Tensor, "objects K"]
    records: list[IterationRecord] = field(default_factory=list)
