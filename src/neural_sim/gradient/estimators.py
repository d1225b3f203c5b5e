"""Estimators of the derivative by psi: the images that each draws, and its estimate from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, get_args

from torch import Tensor

from neural_sim.gradient.accumulated import Accumulated
from neural_sim.gradient.base import Losses, MixedDerivative, ObjectImages, Params, Probes
from neural_sim.gradient.mixed import ThetaMode, scores
from neural_sim.gradient.reinforce import reinforce
from neural_sim.gradient.significance import no_association, no_difference
from neural_sim.gradient.stratified import by_strata
from neural_sim.gradient.unrolled import Wanted
from neural_sim.synthesis.draws import Draws, HardDraws


class Estimator(Protocol):
    """An estimator of the derivative by psi from images.

    ``draws`` is how an iteration's images are drawn, ``probes_per_bin`` the number of further images of every stratum
    of every factor (0: none), ``wanted`` what :meth:`accumulated` reads of the sums over a training's steps.
    """

    wanted: ClassVar[Wanted]

    @property
    def draws(self) -> Draws: ...

    @property
    def probes_per_bin(self) -> int: ...

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign of Eq. 2.

        ``losses`` are those of ``images`` and ``probes``, as functions of ``params``; ``vector`` is v; ``probes`` are
        by factor.
        """
        ...

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        """``dL_val/dpsi`` of one object through the training that was run, sign included."""
        ...


@dataclass(frozen=True)
class StratifiedEstimator:
    """Stratified sampling: mean scores of every bin of every factor, and under every anchor light, from probes of each
    (:mod:`gradient.stratified`).

    An outer iteration costs one Jacobian-vector product over the predictor for its probes, computed by ``theta_mode``
    (see :func:`gradient.mixed.scores`).
    """

    wanted: ClassVar[Wanted] = "probes"
    probes_per_bin: int = 48
    chunk_size: int = 64
    theta_mode: ThetaMode = "central_difference"

    def __post_init__(self) -> None:
        if self.probes_per_bin < 1:
            raise ValueError(f"gradient.probes_per_bin must be at least 1, got {self.probes_per_bin}")
        if self.theta_mode not in get_args(ThetaMode):
            raise ValueError(
                f"gradient.theta_mode must be one of {get_args(ThetaMode)}, got {self.theta_mode!r}"
            )

    @property
    def draws(self) -> HardDraws:
        """Exact samples of p_psi."""
        return HardDraws()

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """See :class:`Estimator`. Null hypothesis of its p-values: a factor's bins, or lights, have equal mean scores,
        so that the derivative is zero.
        """
        scored = losses.probes
        if scored is None:
            raise ValueError("stratified: wants losses of probes, got none")
        return self._over_strata(
            lambda index: scores(scored, params, vector, index, self.chunk_size, self.theta_mode),
            images,
            probes,
        )

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        return self._over_strata(lambda index: sums.probes[index.to(sums.probes.device)], images, probes)

    def _over_strata(
        self, scored: Callable[[Tensor], Tensor], images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        distribution = images.distribution
        if set(probes) != set(distribution.names):
            raise ValueError(
                f"stratified: wants probes of {list(distribution.names)}, which it scores, got {list(probes)}"
            )
        weight, psi, parts, p_values = float(images.weights.sum()), distribution.split(images.psi), {}, {}
        for factor in distribution.factors:
            strata = probes[factor.name]
            along = scored(strata.index).to(images.psi)
            parts[factor.name] = by_strata(along, factor, psi[factor.name], weight)
            p_values[factor.name] = no_difference(along.view(factor.size, -1).T)
        return MixedDerivative(
            distribution.join({name: part.value for name, part in parts.items()}),
            distribution.join({name: part.standard_error for name, part in parts.items()}),
            p_values,
        )


@dataclass(frozen=True)
class ReinforceEstimator:
    """The score function on hard draws with a leave-one-out baseline, see :mod:`gradient.reinforce`."""

    wanted: ClassVar[Wanted] = "weights"
    chunk_size: int = 64

    @property
    def draws(self) -> HardDraws:
        """Samples of p_psi with a density."""
        return HardDraws(explore=True)

    @property
    def probes_per_bin(self) -> int:
        """0: the iteration's own images are scored."""
        return 0

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """See :class:`Estimator`. Null hypothesis of its p-values: scores do not depend on the bins, or lights, that a
        factor drew.
        """
        return self._by_score_function(
            scores(losses.cached, params, vector, images.index, self.chunk_size), images
        )

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        by_weight = sums.images[images.index.to(sums.images.device)]
        return self._by_score_function(by_weight / images.weights.to(by_weight), images)

    def _by_score_function(self, along: Tensor, images: ObjectImages) -> MixedDerivative:
        along = along.to(images.psi)
        weight = float(images.weights.sum())

        def log_prob(psi: Tensor) -> Tensor:
            return images.distribution.log_prob(psi, images.draw)

        drawn = images.distribution.statistics(images.draw)
        p_values = {name: no_association(along, values) for name, values in drawn.items()}
        return replace(reinforce(along, log_prob, images.psi, weight), p_values=p_values)
