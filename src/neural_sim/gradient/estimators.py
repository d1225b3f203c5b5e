"""The estimators by name: which images each draws, and which derivative it takes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from neural_sim.gradient.base import Losses, MixedDerivative, ObjectImages, Params, Probes
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reinforce import reinforce
from neural_sim.gradient.stratified import stratified


@dataclass(frozen=True)
class StratifiedEstimator:
    """Mean scores of every bin from images drawn from it on purpose, see :mod:`gradient.stratified`.

    An outer iteration pays one Jacobian-vector product over the predictor for its probes.
    """

    relaxed: ClassVar[None] = None
    probes_per_bin: int = 8
    chunk_size: int = 64

    def __post_init__(self) -> None:
        if self.probes_per_bin < 1:
            raise ValueError(f"gradient.probes_per_bin must be at least 1, got {self.probes_per_bin}")

    def estimate(
        self, losses: Losses, params: Params, vector: Params, images: ObjectImages, probes: Probes | None
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign."""
        if probes is None or losses.probes is None:
            raise ValueError("stratified: got no probes, which this estimator scores")
        along = scores(losses.probes, params, vector, probes.index, self.chunk_size)
        share = float(images.weights.sum())
        return stratified(
            along.to(images.psi.dtype), probes.bins, images.psi, images.log_probabilities, share
        )


@dataclass(frozen=True)
class ReinforceEstimator:
    """The score function on hard draws with a leave-one-out baseline, see :mod:`gradient.reinforce`."""

    relaxed: ClassVar[None] = None
    probes_per_bin: ClassVar[int] = 0
    chunk_size: int = 64

    def estimate(
        self, losses: Losses, params: Params, vector: Params, images: ObjectImages, probes: Probes | None
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign."""
        along = scores(losses.cached, params, vector, images.index, self.chunk_size)
        share = float(images.weights.sum())

        def log_prob(psi: Tensor) -> Tensor:
            return images.log_probabilities(psi)[images.draw.bins]

        return reinforce(along.to(images.psi.dtype), log_prob, images.psi, share)


Estimator = PathwiseEstimator | StratifiedEstimator | ReinforceEstimator
