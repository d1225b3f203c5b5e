"""Cost of a method or a training."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """Labelled images, optimiser steps of detectors, Hessian products, seconds of wall-clock time and processor seconds
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
