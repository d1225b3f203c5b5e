"""The estimators by name: which images each draws, and which derivative it takes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, get_args

from torch import Tensor

from neural_sim.gradient.base import Losses, MixedDerivative, ObjectImages, Params, Probes
from neural_sim.gradient.mixed import ThetaMode, scores
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.gradient.reinforce import reinforce
from neural_sim.gradient.stratified import by_strata
from neural_sim.synthesis.scene import HardDraws


@dataclass(frozen=True)
class StratifiedEstimator:
    """Mean scores of every bin of every factor, and under every anchor light, from images drawn from it on purpose, see
    :mod:`gradient.stratified`.

    An outer iteration pays one Jacobian-vector product over the predictor for its probes, taken as ``theta_mode`` says
    (see :func:`gradient.mixed.scores`).
    """

    draws: ClassVar[HardDraws] = HardDraws()
    probes_per_bin: int = 16
    chunk_size: int = 64
    theta_mode: ThetaMode = "central_difference"

    def __post_init__(self) -> None:
        if self.probes_per_bin < 1:
            raise ValueError(f"gradient.probes_per_bin must be at least 1, got {self.probes_per_bin}")
        if self.theta_mode not in get_args(ThetaMode):
            raise ValueError(
                f"gradient.theta_mode must be one of {get_args(ThetaMode)}, got {self.theta_mode!r}"
            )

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign."""
        distribution = images.distribution
        if losses.probes is None or set(probes) != set(distribution.names):
            raise ValueError(
                f"stratified: wants probes of {list(distribution.names)}, which it scores, got {list(probes)}"
            )
        share, psi, parts = float(images.weights.sum()), distribution.split(images.psi), {}
        for factor in distribution.factors:
            held = probes[factor.name]
            along = scores(losses.probes, params, vector, held.index, self.chunk_size, self.theta_mode)
            parts[factor.name] = by_strata(along.to(images.psi), held.bins, factor, psi[factor.name], share)
        return MixedDerivative(
            distribution.join({name: part.value for name, part in parts.items()}),
            distribution.join({name: part.standard_error for name, part in parts.items()}),
        )


@dataclass(frozen=True)
class ReinforceEstimator:
    """The score function on hard draws with a leave-one-out baseline, see :mod:`gradient.reinforce`."""

    draws: ClassVar[HardDraws] = HardDraws(explore=True)
    probes_per_bin: ClassVar[int] = 0
    chunk_size: int = 64

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign."""
        along = scores(losses.cached, params, vector, images.index, self.chunk_size)
        share = float(images.weights.sum())

        def log_prob(psi: Tensor) -> Tensor:
            return images.distribution.log_prob(psi, images.draw)

        return reinforce(along.to(images.psi), log_prob, images.psi, share)


Estimator = PathwiseEstimator | StratifiedEstimator | ReinforceEstimator
