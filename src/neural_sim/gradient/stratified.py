"""The derivative over hard bins: with ``E = sum_b p_b s_b`` (s_b the mean score of bin b) it is
``dE/dpsi = sum_b (dp_b/dpsi) s_b``, for logits without a floor ``p_i (s_i - sum_j p_j s_j)``. For lights, differences
of mean scores take the place of the derivative, :func:`across_lights`.

Only mean scores are estimated: every bin is sampled by itself (stratified sampling), whatever p, and the renderer is
never differentiated. All bins show the same scenes, with the same random numbers for all that is not the bin, so that
differences between bins owe nothing to backgrounds and distances.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.gradient.base import MixedDerivative
from neural_sim.parameter.factor import BinnedFactor, Factor

LogProbabilities = Callable[[Float[Tensor, "k"]], Float[Tensor, "k"]]


def importance_weights(
    probabilities: Float[Tensor, "k"], bins: Int[Tensor, "n"], weight: float = 1.0
) -> Float[Tensor, "n"]:
    """Weights ``weight p_b / n_b`` under which images of prescribed bins train as if drawn from p.

    ``weight`` is the object's fraction of the training set. The weights sum to it when every bin of positive p was
    drawn; the mass of other bins is missing, not redistributed.
    """
    counts = torch.bincount(bins, minlength=probabilities.numel())
    return weight * (probabilities / counts.clamp_min(1))[bins]


def stratified(
    table: Float[Tensor, "k n"],
    psi: Float[Tensor, "k"],
    log_probabilities: LogProbabilities,
    weight: float = 1.0,
) -> MixedDerivative:
    """``weight * dE/dpsi`` from the scores of ``n`` scenes, each with the object in every bin.

    Scenes are independent, so that the standard error is that of the mean over scenes of each one's derivative. What a
    scene adds to its scores in all bins alike adds nothing to it. Infinite for one scene.

    Raises:
        ValueError: another shape, or no scene.
    """
    if table.ndim != 2 or table.shape[0] != psi.numel() or table.shape[1] == 0:
        raise ValueError(
            f"stratified: want scores [{psi.numel()} bins, at least one scene], got shape {tuple(table.shape)}"
        )
    # An offset common to all bins moves nothing. Subtracted first, equal scores give exactly 0 instead of a rounding
    # error.
    return _mean((table - table[:1]).T @ _jacobian(log_probabilities, psi), weight)


def by_strata(
    scores: Float[Tensor, "n"], factor: Factor, psi: Float[Tensor, "k"], weight: float = 1.0
) -> MixedDerivative:
    """The derivative by one factor's psi from the scores of its probes, stratum after stratum, by :func:`stratified`;
    for lights :func:`across_lights` instead.
    """
    table = scores.view(factor.size, -1)
    if isinstance(factor, BinnedFactor):
        return stratified(table, psi, factor.log_probabilities, weight)
    return across_lights(table, weight)


def across_lights(table: Float[Tensor, "k n"], weight: float = 1.0) -> MixedDerivative:
    """``weight * (s_i - mean_j s_j)``, s_i the mean score under anchor light i: differences between lights. What is
    common to all lights is subtracted, since the projection onto the constraint removes it.

    This is not the derivative of the training loss by psi, whose weights blend the lights in every image
    (``gradient=pathwise`` computes that one). It is the derivative for another training set: images under single
    lights, a fraction w_i of them under light i. It replaces the derivative by the blend, which says little about a
    large change of light: a detector that never saw a light gains nothing from a trace of it (docs/numerics.md, Lights,
    compares both with the truth). ``table`` has the scores of ``n`` scenes under each light.

    Raises:
        ValueError: no scene.
    """
    if table.numel() == 0:
        raise ValueError(
            f"stratified: want scores [lights, at least one scene], got shape {tuple(table.shape)}"
        )
    return _mean((table - table.mean(0)).T, weight)


def _mean(by_scene: Float[Tensor, "n k"], weight: float) -> MixedDerivative:
    """The mean over independent scenes; of one scene the standard error is infinite."""
    count = len(by_scene)
    error = by_scene.std(0) / count**0.5 if count > 1 else torch.full_like(by_scene[0], torch.inf)
    return MixedDerivative(weight * by_scene.mean(0), weight * error)


def _jacobian(log_probabilities: LogProbabilities, psi: Tensor) -> Float[Tensor, "k k"]:
    """``dp_b/dpsi_i`` at row b, column i."""
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        p = log_probabilities(leaf).exp()
    return torch.stack([torch.autograd.grad(part, leaf, retain_graph=True)[0] for part in p])
