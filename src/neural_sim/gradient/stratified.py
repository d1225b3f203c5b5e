"""The derivative over hard bins: with ``E = sum_b p_b s_b`` (s_b the mean score of bin b) it is
``dE/dpsi = sum_b (dp_b/dpsi) s_b``, for logits without a floor ``p_i (s_i - sum_j p_j s_j)``. For lights, differences
of mean scores take the place of the derivative, :func:`across_lights`.

Only mean scores are estimated: every bin is sampled by itself (stratified sampling), whatever p, and the renderer is
never differentiated.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.gradient.base import MixedDerivative
from neural_sim.parameter.factor import Factor

logger = logging.getLogger(__name__)
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
    scores: Float[Tensor, "n"],
    bins: Int[Tensor, "n"],
    psi: Float[Tensor, "k"],
    log_probabilities: LogProbabilities,
    weight: float = 1.0,
) -> MixedDerivative:
    """``weight * dE/dpsi`` from scores of images of known bins, however many each bin has.

    A bin without images gets the p-weighted mean score of the others (logged), at which its own derivative is zero, and
    an infinite standard error. Variances within bins are pooled for bins of
    one image.
    """
    _check(scores, bins, psi)
    counts = torch.bincount(bins, minlength=psi.numel()).to(scores.dtype)
    seen = counts > 0
    total = torch.zeros_like(counts).index_add_(0, bins, scores)
    means = total / counts.clamp_min(1.0)
    variance = _variance_of_means(scores - means[bins], bins, counts)
    p, slopes = _jacobian(log_probabilities, psi)
    # A common offset moves nothing. Subtracted first, equal scores give exactly 0 instead of a rounding error.
    means = torch.where(seen, means - means[seen][0], 0.0)
    if not bool(seen.all()):
        logger.info("stratified: bins %s have no images", (~seen).nonzero().flatten().tolist())
        mass = p[seen].sum()  # 0 where p is one-hot on a bin without images
        mean = (p * means)[seen].sum() / mass if mass > 0.0 else means[seen].mean()
        means = torch.where(seen, means, mean)
    # A bin of slope 0 adds nothing, also where its variance is infinite: 0 * inf would be NaN.
    spread = torch.where(slopes == 0.0, torch.zeros_like(slopes), slopes.square() * variance[:, None])
    return MixedDerivative(weight * (means @ slopes), weight * spread.sum(0).sqrt())


def by_strata(
    scores: Float[Tensor, "n"],
    strata: Int[Tensor, "n"],
    factor: Factor,
    psi: Float[Tensor, "k"],
    weight: float = 1.0,
) -> MixedDerivative:
    """The derivative by one factor's psi from the scores of its probes, by :func:`stratified`; for lights
    :func:`across_lights` instead."""
    if factor.same_scenes:
        return across_lights(scores, factor.size, weight)
    return stratified(scores, strata, psi, factor.log_probabilities, weight)


def across_lights(scores: Float[Tensor, "n"], lights: int, weight: float = 1.0) -> MixedDerivative:
    """``weight * (s_i - mean_j s_j)``, s_i the mean score under anchor light i: differences between lights. What is
    common to all lights is subtracted, since the projection onto the constraint removes it.

    This is not the derivative of the training loss by psi, whose weights blend the lights in every image
    (``gradient=pathwise`` computes that one). It is the derivative for another training set: images under single
    lights, a fraction w_i of them under light i. It replaces the derivative by the blend, which says little about a
    large change of light: a detector that never saw a light gains nothing from a trace of it (docs/numerics.md, Lights,
    compares both with the truth). ``scores`` are those of the same scenes under one light after the other.
    """
    if lights < 1 or scores.ndim != 1 or scores.numel() == 0 or scores.numel() % lights:
        raise ValueError(
            f"stratified: want equally many scores under each of {lights} lights, got shape {tuple(scores.shape)}"
        )
    table = scores.view(lights, -1)
    apart = table - table.mean(0)
    count = table.shape[1]
    error = apart.std(1) / count**0.5 if count > 1 else torch.full_like(apart[:, 0], torch.inf)
    return MixedDerivative(weight * apart.mean(1), weight * error)


def _variance_of_means(residuals: Tensor, bins: Tensor, counts: Tensor) -> Float[Tensor, "k"]:
    squares = torch.zeros_like(counts).index_add_(0, bins, residuals.square())
    freedom = counts - 1.0
    spare = freedom.clamp_min(0.0).sum()
    pooled = squares.sum() / spare if spare > 0 else squares.new_tensor(torch.inf)
    within = torch.where(freedom > 0, squares / freedom.clamp_min(1.0), pooled)
    return torch.where(counts > 0, within / counts.clamp_min(1.0), torch.full_like(counts, torch.inf))


def _jacobian(
    log_probabilities: LogProbabilities, psi: Tensor
) -> tuple[Float[Tensor, "k"], Float[Tensor, "k k"]]:
    """p, and ``dp_b/dpsi_i`` at row b, column i."""
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        p = log_probabilities(leaf).exp()
    rows = [torch.autograd.grad(p[b], leaf, retain_graph=True)[0] for b in range(p.numel())]
    return p.detach(), torch.stack(rows)


def _check(scores: Tensor, bins: Tensor, psi: Tensor) -> None:
    if scores.ndim != 1 or scores.shape != bins.shape or scores.numel() == 0:
        raise ValueError(
            f"stratified: want equally many scores and bins, at least one, got shapes {tuple(scores.shape)} "
            f"and {tuple(bins.shape)}"
        )
    if int(bins.min()) < 0 or int(bins.max()) >= psi.numel():
        raise ValueError(
            f"stratified: bins must lie in [0, {psi.numel()}), got {int(bins.min())} to {int(bins.max())}"
        )
