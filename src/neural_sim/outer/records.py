"""Results of an outer loop: one record per iteration, and the trajectory of psi."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.outer.certificate import Certificate, ImplicitQuality, UnrolledQuality
from neural_sim.outer.steps import Verdict
from neural_sim.outer.way import TakenBack


@dataclass(frozen=True)
class Cost:
    """Cost of a method or a training.

    It counts labelled images, optimiser steps of detectors, Hessian products, wall-clock seconds, and processor seconds
    over all cores.
    """

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


@dataclass(frozen=True)
class Outcome:
    """What an iteration's trainings decided about earlier steps.

    Attributes:
        verdicts: verdicts on the objects whose last step was accepted or rejected.
        taken_back: at the end, the objects that go back because their best psi was not the last one.
    """

    verdicts: Mapping[str, Verdict] = field(default_factory=dict)
    taken_back: Mapping[str, TakenBack] = field(default_factory=dict)


@dataclass(frozen=True)
class IterationRecord:
    """One outer iteration.

    ``probabilities`` and ``entropies`` (nats), by factor and object, describe the distribution from which the images
    were drawn, before the step. ``gradient_norms`` and ``gradient_errors`` are, by object, the norms of dL_val/dpsi and
    of its standard errors; empty without a derivative. ``images`` counts labelled images, including probes,
    ``detector_steps`` optimiser steps and ``products`` Hessian products. ``seconds`` are wall-clock times by phase;
    ``cpu_seconds``, the processor time over all cores, depends less on other processes on the machine. ``certificate``
    is None for methods with rewards, and in an iteration without a derivative. ``scores`` [classes] are those of the
    loop's objective; higher is better. For ``verdicts`` and ``taken_back`` see ``Outcome``.
    """

    probabilities: dict[str, list[list[float]]]
    entropies: dict[str, list[float]]
    gradient_norms: list[float]
    gradient_errors: list[float]
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
    taken_back: dict[str, TakenBack]


def cost_of(record: IterationRecord) -> Cost:
    """Return the cost of one iteration. Phases ``hypergradient_*`` are parts of ``hypergradient``, counted once."""
    phases = record.seconds.items()
    seconds = sum(spent for phase, spent in phases if not phase.startswith("hypergradient_"))
    return Cost(record.images, record.detector_steps, record.products, seconds, record.cpu_seconds)


def record_of(stored: Mapping[str, Any]) -> IterationRecord:
    """Restore a record from its ``dataclasses.asdict``."""
    certificate = stored["certificate"]
    return IterationRecord(
        **{
            **stored,
            "certificate": certificate and _certificate_of(certificate),
            "verdicts": {name: Verdict(**verdict) for name, verdict in stored["verdicts"].items()},
            "taken_back": {name: TakenBack(**back) for name, back in stored["taken_back"].items()},
        }
    )


def _certificate_of(stored: Mapping[str, Any]) -> Certificate:
    adjoint = stored["adjoint"]
    if adjoint is not None:
        kind = UnrolledQuality if "reversed_steps" in adjoint else ImplicitQuality
        adjoint = kind(**adjoint)
    return Certificate(**{**stored, "adjoint": adjoint})


@dataclass(frozen=True)
class LearnedPsi:
    """The result of the loop.

    ``trajectory`` has the method's psi before the first iteration and after each. A trust-region step enters it at once
    and is undone an iteration later if it is rejected; the last entry is the psi that the loop returns. ``before`` is
    the cost before the first iteration: that of the warm start, whose backbone every loop uses, or of the estimate
    ``shown`` for a method that estimates psi from the target.
    """

    trajectory: Float[Tensor, "psis objects K"]
    records: list[IterationRecord]
    before: Cost = field(default_factory=Cost)
    shown: tuple[FactorEstimate, ...] = ()

    def cost(self, iterations: int) -> Cost:
        """Sum the cost up to a number of iterations; it is 0 for none, because the initial psi is free."""
        return sum(
            (cost_of(record) for record in self.records[:iterations]), self.before if iterations else Cost()
        )

    @property
    def last(self) -> Float[Tensor, "objects K"]:
        """The method's final psi."""
        return self.trajectory[-1]
