"""The protocol of estimators, and the two that use image scores: stratified (the default) and REINFORCE."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.gradient.base import (
    Losses,
    MixedDerivative,
    ObjectImages,
    Params,
    Probes,
    from_contributions,
)
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.reversal import Wanted
from neural_sim.gradient.significance import no_association, no_difference
from neural_sim.gradient.unrolled import Accumulated
from neural_sim.parameter.bins import is_closed
from neural_sim.parameter.factor import BinnedFactor, Factor
from neural_sim.parameter.product import Draws, HardDraws
from neural_sim.ranges import PositiveInt, validated

LogProbabilities = Callable[[Float[Tensor, "k"]], Float[Tensor, "k"]]


class Estimator(Protocol):
    """An estimator of the derivative with respect to psi.

    ``wanted`` names the sums over a training's steps that ``accumulated`` reads.
    """

    wanted: ClassVar[Wanted]

    @property
    def draws(self) -> Draws:
        """How an iteration's images are drawn."""
        ...

    @property
    def probes_per_bin(self) -> int:
        """Number of additional images in each stratum of each factor; 0: none."""
        ...

    def estimate(
        self,
        losses: Losses,
        params: Params,
        vector: Params,
        images: ObjectImages,
        probes: Mapping[str, Probes],
    ) -> MixedDerivative:
        """Estimate ``d/dpsi <dL_train/dtheta, v>`` of one object, without the minus sign of Eq. 2.

        Args:
            losses: losses of ``images`` and ``probes`` as functions of ``params``.
            params: the trained parameters.
            vector: v.
            images: the object's training images.
            probes: the object's probes, by factor.
        """
        ...

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        """Estimate ``dL_val/dpsi`` of one object from sums over the steps of a recorded training."""
        ...


@validated
@dataclass(frozen=True)
class StratifiedEstimator:
    """Stratified sampling: the derivative over hard bins, from the mean scores of probes in every bin.

    With ``E = sum_b p_b s_b`` (s_b the mean score of bin b) the derivative is ``dE/dpsi = sum_b (dp_b/dpsi) s_b``,
    which for logits without a floor is ``p_i (s_i - sum_j p_j s_j)``. Lights use differences of mean scores instead,
    see ``across_lights``.

    Only the mean scores are estimated. Every bin has the same number of probes, however small its p, and the renderer
    is never differentiated. All bins show the same scenes: everything random except the bin is shared, so that, for
    example, the backgrounds cancel in differences between bins. With the implicit adjoint, the probes' scores take one
    Jacobian-vector product by central differences, whose error is far below that of sampling.
    """

    wanted: ClassVar[Wanted] = "probes"
    probes_per_bin: PositiveInt = 48
    chunk_size: PositiveInt = 64

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
        """See ``Estimator``.

        The p-values test the null hypothesis that a factor's open bins, or its lights, have equal mean scores, so that
        the derivative is zero.
        """
        scored = losses.probes
        if scored is None:
            raise ValueError("stratified: want losses of probes, got none")
        return self._over_strata(
            lambda index: scores(scored, params, vector, index, self.chunk_size, "central_difference"),
            images,
            probes,
        )

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        """See ``Estimator``."""
        return self._over_strata(lambda index: sums.probes[index.to(sums.probes.device)], images, probes)

    def _over_strata(
        self, scored: Callable[[Tensor], Tensor], images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        distribution = images.distribution
        if set(probes) != set(distribution.names):
            raise ValueError(
                f"stratified: want probes of every factor, {list(distribution.names)}, got {list(probes)}"
            )
        weight, psi = float(images.weights.sum()), distribution.split(images.psi)
        parts: dict[str, MixedDerivative] = {}
        p_values: dict[str, float] = {}
        for factor in distribution.factors:
            strata = probes[factor.name]
            along = scored(strata.index).to(images.psi)
            parts[factor.name] = by_strata(along, factor, psi[factor.name], weight)
            counted = ~is_closed(psi[factor.name])  # scores of closed bins have no effect on the derivative
            p_values[factor.name] = no_difference(along.view(factor.size, -1)[counted].T)
        return MixedDerivative(
            distribution.join({name: part.value for name, part in parts.items()}),
            distribution.join({name: part.standard_error for name, part in parts.items()}),
            p_values,
        )


def stratified(
    table: Float[Tensor, "k n"],
    psi: Float[Tensor, "k"],
    log_probabilities: LogProbabilities,
    weight: float = 1.0,
) -> MixedDerivative:
    """Estimate ``weight * dE/dpsi`` from the scores of ``n`` scenes, each rendered with the object in every bin.

    Scenes are independent, so the standard error is that of the mean of their derivatives (infinite for a single
    scene). An offset that a scene adds to its scores in all bins cancels.

    Raises:
        ValueError: the table does not have one row for each bin, or has no scene.
    """
    if table.ndim != 2 or table.shape[0] != psi.numel() or table.shape[1] == 0:
        raise ValueError(
            f"stratified: want scores [{psi.numel()} bins, at least one scene], got shape {tuple(table.shape)}"
        )
    # A common offset of all bins has no effect. It is subtracted first, so that equal scores give exactly 0 and not
    # a rounding error.
    return _mean((table - table[:1]).T @ _jacobian(log_probabilities, psi), weight)


def by_strata(
    scores: Float[Tensor, "n"], factor: Factor, psi: Float[Tensor, "k"], weight: float = 1.0
) -> MixedDerivative:
    """Estimate the derivative with respect to one factor's psi from its probes' scores, ordered by stratum.

    Bins use ``stratified``, lights ``across_lights``.
    """
    table = scores.view(factor.size, -1)
    if isinstance(factor, BinnedFactor):
        return stratified(table, psi, factor.log_probabilities, weight)
    return across_lights(table, weight)


def across_lights(table: Float[Tensor, "k n"], weight: float = 1.0) -> MixedDerivative:
    """Estimate ``weight * (s_i - mean_j s_j)`` from the scores of ``n`` scenes, each under every anchor light.

    s_i is the mean score under light i. The mean over lights is subtracted, because the projection onto the constraint
    would remove it in any case.

    This is not the derivative of the training loss by psi: psi blends the lights in every image, and
    ``gradient=pathwise`` computes the derivative with respect to that blend. It is the derivative for another training
    set, in which each image has a single light, and a fraction w_i of the images has light i. The derivative with
    respect to the blend says little about a large change of light: a detector that never saw a light gains nothing from
    a trace of it. docs/numerics.md, Lights, compares both with the actual fall of the loss.

    Raises:
        ValueError: there is no scene.
    """
    if table.numel() == 0:
        raise ValueError(
            f"stratified: want scores [lights, at least one scene], got shape {tuple(table.shape)}"
        )
    return _mean((table - table.mean(0)).T, weight)


def importance_weights(
    probabilities: Float[Tensor, "k"], bins: Int[Tensor, "n"], weight: float = 1.0
) -> Float[Tensor, "n"]:
    """Compute weights ``weight p_b / n_b``, with which images of given bins train as if drawn from p.

    ``weight`` is the object's fraction of the training set. The weights sum to it if every bin with positive p was
    drawn; the mass of bins that were not drawn is missing, not redistributed.
    """
    counts = torch.bincount(bins, minlength=probabilities.numel())
    return weight * (probabilities / counts.clamp_min(1))[bins]


def _mean(by_scene: Float[Tensor, "n k"], weight: float) -> MixedDerivative:
    """Take the mean over independent scenes; the standard error of a single scene is infinite."""
    count = len(by_scene)
    error = by_scene.std(0) / count**0.5 if count > 1 else torch.full_like(by_scene[0], torch.inf)
    return MixedDerivative(weight * by_scene.mean(0), weight * error)


def _jacobian(log_probabilities: LogProbabilities, psi: Tensor) -> Float[Tensor, "k k"]:
    """Compute dp_b/dpsi_i, in row b and column i."""
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        p = log_probabilities(leaf).exp()
    return torch.stack([torch.autograd.grad(part, leaf, retain_graph=True)[0] for part in p])


@validated
@dataclass(frozen=True)
class ReinforceEstimator:
    """The score-function estimator (Williams 1992) on hard draws, with a leave-one-out baseline (Kool et al. 2019)."""

    wanted: ClassVar[Wanted] = "weights"
    chunk_size: PositiveInt = 64

    @property
    def draws(self) -> HardDraws:
        """Independent samples of p_psi, with lights drawn around psi's, so that the draws have a density."""
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
        """See ``Estimator``.

        The p-values test the null hypothesis that scores do not depend on the bins or lights that were drawn.
        """
        return self._by_score_function(
            scores(losses.cached, params, vector, images.index, self.chunk_size), images
        )

    def accumulated(
        self, sums: Accumulated, images: ObjectImages, probes: Mapping[str, Probes]
    ) -> MixedDerivative:
        """See ``Estimator``."""
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


def reinforce(
    scores: Float[Tensor, "n"],
    log_prob: Callable[[Float[Tensor, "K"]], Float[Tensor, "n"]],
    psi: Float[Tensor, "K"],
    weight: float = 1.0,
) -> MixedDerivative:
    """Estimate ``weight * d/dpsi E[s]`` by the mean of ``weight (s_i - b_i) dlog p(V_i)/dpsi`` over independent draws.

    ``b_i``, the mean of the other draws' scores, is independent of draw i, so the estimate stays unbiased. ``log_prob``
    maps psi to the draws' log-probabilities.

    Raises:
        ValueError: there are fewer than 2 draws, or not as many log-probabilities as draws.
    """
    count = scores.numel()
    if scores.ndim != 1 or count < 2:
        raise ValueError(
            f"reinforce: a leave-one-out baseline needs at least 2 scores, got shape {tuple(scores.shape)}"
        )
    advantage = (scores - scores.mean()) * (count / (count - 1))
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        log_probabilities = log_prob(leaf)
    if log_probabilities.shape != scores.shape:
        raise ValueError(
            f"reinforce: want {count} log-probabilities, as many as scores, got shape {tuple(log_probabilities.shape)}"
        )
    slopes = [
        torch.autograd.grad(entry, leaf, retain_graph=True, materialize_grads=True)[0]
        for entry in log_probabilities
    ]
    return from_contributions(weight / count * advantage[:, None] * torch.stack(slopes))
