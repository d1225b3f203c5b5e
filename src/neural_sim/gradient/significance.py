"""Tests whether a derivative differs from zero: one p-value for all components of a factor of psi together.

The statistic is ``Q = sum_j (sum_i c_ij)^2 / sum_i c_ij^2``, where c_ij is image i's contribution to component j of the
derivative. Each component is divided by its own variance, so that bins with scattered scores and rare bins weigh no
more than others; an image that is alone in its bin adds about 1 to Q whatever its score. The distribution of Q under
the null hypothesis comes from resampling: the data are changed at random in ways that should not matter if the
hypothesis holds. The p-value is the fraction of samples, including the data themselves, whose Q is at least that of the
data. If the changes leave the distribution of the scores invariant, the level is exact whatever that distribution is
(Phipson and Smyth 2010). The random changes are the same in every call.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Num
from torch import Tensor

DRAWS = 999
"""Number of random changes of the data. Counting the data themselves, p-values are multiples of ``SMALLEST``."""
SMALLEST = 1.0 / (DRAWS + 1)
_BLOCK = 250
# A change that gives the same data again, or their mirror image, has the same Q up to rounding and must count.
_TIE = 1.0 - 1e-9


def zero_mean(rows: Float[Tensor, "n k"], draws: int = DRAWS) -> float:
    """Test that independent ``rows`` have mean zero, by random changes of their signs; return the p-value.

    The test is exact for rows symmetric about zero, whatever their tails, their variances and the dependence between
    their components. Rows of zeros add nothing: with m other rows, the p-value is at least about 2^(1 - m). It is 1 if
    all rows are zero, or if a value is not finite.
    """
    rows = _scaled(rows.double())
    if not bool(rows.any()):
        return 1.0
    squares = rows.square().sum(0)

    def changed(count: int, generator: torch.Generator) -> Tensor:
        signs = torch.randint(2, (count, len(rows)), generator=generator).double() * 2.0 - 1.0
        return _statistic(signs @ rows, squares)

    return _p_value(_statistic(rows.sum(0), squares), changed, draws)


def no_association(scores: Float[Tensor, "n"], drawn: Num[Tensor, "n k"], draws: int = DRAWS) -> float:
    """Test that images' ``scores`` have the same mean whatever was ``drawn`` for them; return the p-value.

    ``drawn`` holds each image's bin, one-hot, or other numbers that were drawn. The contributions
    ``(s_i - mean s)(d_i - mean d)`` are changed at random.

    The result is the larger of two p-values, so that the level holds if either test's condition does. Permuting the
    scores over the images is exact if scores do not depend on what was drawn, whatever their distribution, its
    skewness and the number of images. Changing signs (``zero_mean``) covers bins whose scores scatter differently, if
    they scatter symmetrically. Asymptotically each test holds without its condition (Chung and Romano 2013, for
    permutations of such a statistic). The result is 1 if a number is not finite.
    """
    residuals, drawn = _centred(scores.double()), _centred(drawn.double())
    flipped = zero_mean(residuals[:, None] * drawn, draws)
    if flipped == 1.0:
        return 1.0
    squared = drawn.square()

    def changed(count: int, generator: torch.Generator) -> Tensor:
        order = torch.rand(count, len(residuals), generator=generator, dtype=torch.float64).argsort(1)
        permuted = residuals[order]
        return _statistic(permuted @ drawn, permuted.square() @ squared)

    observed = _statistic(residuals @ drawn, residuals.square() @ squared)
    return max(flipped, _p_value(observed, changed, draws))


def no_difference(scores: Float[Tensor, "scenes strata"], draws: int = DRAWS) -> float:
    """Test that the same scenes have the same mean score in every stratum (bin or light); return the p-value.

    Each scene's deviations from its mean score are changed at random.

    The result is the larger of two p-values, as in ``no_association``. Permuting each scene's scores among the strata
    is exact if a scene's scores differ by chance alone, whatever their distribution; changing signs covers strata in
    which scores scatter differently.
    """
    apart = scores.double() - scores.double()[:, :1]
    rows = _scaled((apart - apart.mean(-1, keepdim=True)).flatten()).view_as(apart)
    flipped = zero_mean(rows, draws)
    if flipped == 1.0:
        return 1.0

    def changed(count: int, generator: torch.Generator) -> Tensor:
        order = torch.rand(count, *rows.shape, generator=generator, dtype=torch.float64).argsort(-1)
        permuted = rows.expand(count, -1, -1).gather(-1, order)
        return _statistic(permuted.sum(1), permuted.square().sum(1))

    return max(flipped, _p_value(_statistic(rows.sum(0), rows.square().sum(0)), changed, draws))


def _p_value(observed: Tensor, changed: Callable[[int, torch.Generator], Tensor], draws: int) -> float:
    generator, beyond = torch.Generator().manual_seed(0), 1
    for first in range(0, draws, _BLOCK):
        beyond += int((changed(min(_BLOCK, draws - first), generator) >= observed * _TIE).sum())
    return beyond / (draws + 1)


def _statistic(sums: Float[Tensor, "*d k"], squares: Float[Tensor, "... k"]) -> Float[Tensor, "*d"]:
    """Compute Q; a component without contributions adds 0."""
    ratio = sums.square() / torch.where(squares > 0.0, squares, 1.0)
    return torch.where(squares > 0.0, ratio, 0.0).sum(-1)


def _centred(values: Float[Tensor, "n *k"]) -> Float[Tensor, "n *k"]:
    """Subtract the mean of the values and scale them, so that squares neither over- nor underflow.

    The first value is subtracted before the mean: equal values then give exactly 0, not a rounding error.
    """
    apart = values - values[:1]
    return _scaled(apart - apart.mean(0))


def _scaled(values: Float[Tensor, "n *k"]) -> Float[Tensor, "n *k"]:
    """Divide each component by its largest absolute value, so that no square over- or underflows.

    If any value is not finite, the result is zeros.
    """
    if not bool(values.isfinite().all()):
        return torch.zeros_like(values)
    largest = values.abs().amax(0, keepdim=True)
    return values / torch.where(largest > 0.0, largest, 1.0)
