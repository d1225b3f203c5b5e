"""The estimators by name: which images each draws, and which derivative it takes of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Int
from torch import Tensor

from neural_sim.gradient.base import ImageLoss, IndexedLoss, MixedDerivative, ObjectImages, Params
from neural_sim.gradient.mixed import Mode, scores
from neural_sim.gradient.pathwise import Pathwise
from neural_sim.gradient.reinforce import reinforce
from neural_sim.gradient.stratified import stratified


@dataclass(frozen=True)
class Probes:
    """Images of one object drawn from every bin on purpose: their rows among all probes, and their bins."""

    index: Int[Tensor, "m"]
    bins: Int[Tensor, "m"]


@dataclass(frozen=True)
class Losses:
    """Per-image losses of the training images (from cached features, and from the images), and of the probes."""

    cached: IndexedLoss
    from_images: ImageLoss
    probes: IndexedLoss | None = None


@dataclass(frozen=True)
class PathwiseEstimator:
    """The paper's: relaxed draws, differentiated through the renderer, see :mod:`gradient.pathwise`."""

    relaxed: ClassVar[bool] = True
    probes_per_bin: ClassVar[int] = 0
    patch_size: int = 4096
    chunk_size: int = 16
    mode: Mode = "forward"

    def estimate(
        self, losses: Losses, params: Params, vector: Params, images: ObjectImages, probes: Probes | None
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign."""
        inner = Pathwise(self.patch_size, self.chunk_size, self.mode)
        return inner.estimate(losses.from_images, params, vector, images)


@dataclass(frozen=True)
class StratifiedEstimator:
    """Mean scores of every bin from images drawn from it on purpose, see :mod:`gradient.stratified`.

    An outer iteration pays one Jacobian-vector product over the predictor for its probes. ``shrink`` scales each
    component by max(0, 1 - 1 / snr^2), the positive-part rule of James and Stein (1961), so that components that
    cannot be told from noise do not move psi.
    """

    relaxed: ClassVar[bool] = False
    probes_per_bin: int = 8
    chunk_size: int = 64
    shrink: bool = True

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
        found = stratified(
            along.to(images.psi.dtype), probes.bins, images.psi, images.log_probabilities, share
        )
        if not self.shrink:
            return found
        kept = (1.0 - found.signal_to_noise.square().clamp_min(1e-12).reciprocal()).clamp_min(0.0)
        return MixedDerivative(found.value * kept, found.standard_error)


@dataclass(frozen=True)
class ReinforceEstimator:
    """The score function on hard draws with a leave-one-out baseline, see :mod:`gradient.reinforce`."""

    relaxed: ClassVar[bool] = False
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
