"""A categorical distribution over bins and its Gumbel-softmax relaxation (paper, Sec. 3.1, Tool 1).

Every draw is a pure function of the logits psi and of noise drawn beforehand, so it can be replayed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.parameter.distributions import project_simplex

# ``bounded`` keeps every bin's softmax at or above this fraction of the floor times the largest bin's softmax. At that
# bound, p exceeds the floor by at most this fraction of it.
LOWEST = 0.25
# Logit of a closed bin, from which nothing may be drawn, such as one that no photograph of the object shows. Its p is
# 0, without a floor, and no step reopens it. Steps never reach so low a logit, so it cannot be mistaken for an open
# bin's, and yet a sum that contains it keeps enough digits of the other logits.
CLOSED = -1e9


@dataclass(frozen=True)
class BinNoise:
    """Noise that selects the bins of n draws.

    With an ``offset``, uniform in [0, 1), exact draws are balanced over the bins (see ``balanced``); without it, they
    are independent.
    """

    gumbel: Float[Tensor, "n k"]
    offset: float | None = None

    def select(self, index: Int[Tensor, "m"]) -> BinNoise:
        """Select draws by index, repeats allowed. The offset is dropped: only all n draws together are balanced."""
        return BinNoise(self.gumbel[index])


def is_closed(psi: Float[Tensor, "*n k"]) -> Bool[Tensor, "*n k"]:
    """Find the bins from which nothing may be drawn."""
    return psi.detach() < 0.5 * CLOSED


def closing(psi: Float[Tensor, "*n k"], closed: Bool[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
    """Close bins, whatever their psi was; return psi itself if none is to be closed."""
    return torch.where(closed, torch.full_like(psi, CLOSED), psi) if bool(closed.any()) else psi


def log_probabilities(psi: Float[Tensor, "*n k"], floor: float = 0.0) -> Float[Tensor, "*n k"]:
    """Compute log p for p = (1 - k floor) softmax(psi) + floor, so that no bin's probability falls below ``floor``.

    The floor lets every open bin be drawn and keeps its log p finite, whatever psi is. Closed bins have no floor, and k
    counts only the open ones.

    Raises:
        ValueError: unless 0 <= floor < 1 / (number of all bins).
    """
    bins = psi.shape[-1]
    if not 0.0 <= floor < 1.0 / bins:
        raise ValueError(f"parameter: floor must lie in [0, 1/{bins}), got {floor}")
    above = log_slopes(psi, floor)
    if floor == 0.0:
        return above
    floored = torch.logaddexp(above, torch.full_like(psi, math.log(floor)))
    closed = is_closed(psi)
    return torch.where(closed, above, floored) if bool(closed.any()) else floored


def log_slopes(psi: Float[Tensor, "*n k"], floor: float = 0.0) -> Float[Tensor, "*n k"]:
    """Compute log w for w = p - ``floor``, without cancellation.

    The derivative of any f(p) with respect to psi is w (f' - sum(w f') / sum(w)); divided by w, it is f', the
    derivative with respect to p, up to a constant. Divided by p instead, it would vanish for bins at the floor.
    """
    closed = is_closed(psi)
    if not bool(closed.any()):
        return torch.log_softmax(psi, -1) + math.log1p(-psi.shape[-1] * floor)
    return torch.log_softmax(psi, -1) + torch.log1p(-floor * (~closed).sum(-1, keepdim=True))


def bounded(psi: Float[Tensor, "*n k"], floor: float = 0.0) -> Float[Tensor, "*n k"]:
    """Raise logits that lie further below the largest than log(1 / (``LOWEST`` ``floor``)).

    At that logit, p exceeds the floor by at most a quarter. Further down, p hardly changes, and a few steps could not
    bring the bin back. Closed bins stay closed.
    """
    if floor == 0.0:
        return psi
    raised = torch.maximum(psi, psi.amax(-1, keepdim=True) - math.log(1.0 / (LOWEST * floor)))
    return closing(raised, is_closed(psi))


def nearest(
    values: Float[Tensor, "*n k"],
    floor: float = 0.0,
    least: Float[Tensor, "*n k"] | float = 0.0,
    closed: Bool[Tensor, "*n k"] | None = None,
) -> Float[Tensor, "*n k"]:
    """Find the probabilities that are nearest to ``values`` (Euclidean) and not below a bound.

    The bound is ``least``, whose sum must be less than 1, or the p of a logit that ``bounded`` has raised (with the
    largest softmax taken as 1), whichever is larger. ``closed`` bins get 0.
    """
    bins = values.shape[-1]
    lowest = (torch.zeros_like(values) + least).clamp_min(floor + LOWEST * floor * (1.0 - bins * floor))
    if closed is not None and bool(closed.any()):
        # Far enough below the others that the projection leaves nothing there.
        lowest = lowest.masked_fill(closed, 0.0)
        values = torch.where(
            closed, values.masked_fill(closed, -torch.inf).amax(-1, keepdim=True) - 4.0, values
        )
    rest = 1.0 - lowest.sum(-1, keepdim=True)
    return lowest + rest * project_simplex((values - lowest) / rest)


def logits(
    probabilities: Float[Tensor, "*n k"], floor: float = 0.0, closed: Bool[Tensor, "*n k"] | None = None
) -> Float[Tensor, "*n k"]:
    """Compute centred logits of ``probabilities``, clamped to just above the floor; see ``log_probabilities``.

    The probability of ``closed`` bins is shared among the others in proportion to theirs.
    """
    if closed is not None and bool(closed.any()):
        open_ = (~closed).sum(-1, keepdim=True)
        p = probabilities.masked_fill(closed, 0.0)
        above_floor = ((p / p.sum(-1, keepdim=True) - floor) / (1.0 - open_ * floor)).clamp_min(1e-6)
        log_p = above_floor.log().masked_fill(closed, 0.0)
        return closing(log_p - log_p.sum(-1, keepdim=True) / open_, closed)
    bins = probabilities.shape[-1]
    above_floor = ((probabilities - floor) / (1.0 - bins * floor)).clamp_min(1e-6)
    log_p = above_floor.log()
    return log_p - log_p.mean(-1, keepdim=True)


def gumbel(shape: tuple[int, ...], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Draw standard Gumbel noise, from uniforms kept away from 0 and 1 so that it is finite in every dtype."""
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
    return -(-(uniform.clamp(1e-12, 1.0 - 1e-12)).log()).log().to(dtype)


def balanced(log_p: Float[Tensor, "k"], gumbel: Float[Tensor, "n k"], offset: float) -> Int[Tensor, "n"]:
    """Draw n bins, each of which follows p, with bin b drawn n p_b times, rounded down or up.

    The counts are those of systematic sampling: a bin is drawn once for each of the points ``offset``, ``offset`` + 1,
    ... below n (``offset`` uniform in [0, 1)) in its interval of the cumulative sum of n p. The draws start as those of
    the Gumbel-max trick. Draws then move from bins that have too many to bins that have too few, first those whose
    log p plus noise falls least. Most draws therefore keep their bins when p changes under the same noise.

    Raises:
        ValueError: log p contains NaN.
    """
    count, k = gumbel.shape
    p = log_p.double().softmax(-1)
    if bool(p.isnan().any()):
        raise ValueError(f"parameter: want finite psi to draw bins from, got log p {log_p.tolist()}")  # pyright: ignore[reportUnknownMemberType]
    ends = torch.cat([p.new_zeros(1), (count * p[:-1].cumsum(-1) - offset).ceil(), p.new_tensor([count])])
    wanted = ends.diff().long()
    values = log_p.double() + gumbel.double()
    chosen = values.argmax(-1)
    have = torch.bincount(chosen, minlength=k)
    while bool((have > wanted).any()):
        loss = values.gather(1, chosen[:, None]) - values
        barred = (have <= wanted)[chosen][:, None] | (have >= wanted)
        row, into = divmod(int(loss.masked_fill(barred, torch.inf).argmin()), k)
        have[chosen[row]] -= 1
        have[into] += 1
        chosen[row] = into
    return chosen


def gumbel_softmax(
    log_p: Float[Tensor, "... k"], noise: Float[Tensor, "*n k"], temperature: float
) -> Float[Tensor, "*n k"]:
    """Compute y of Eq. 4: softmax((G + log p) / tau). The index of its largest component follows p for every tau > 0.

    Raises:
        ValueError: unless the temperature is positive.
    """
    if not temperature > 0.0:
        raise ValueError(f"parameter: temperature must be positive, got {temperature}")
    return torch.softmax((noise + log_p) / temperature, -1)


def centres(bins: int, low: float, high: float, like: Tensor) -> Float[Tensor, "k"]:
    """Compute the centres of ``bins`` equal bins of [low, high], in the unit of ``low``."""
    steps = torch.arange(bins, dtype=like.dtype, device=like.device) + 0.5
    return low + (high - low) / bins * steps


def linear_mean(weights: Float[Tensor, "*n k"], bin_centres: Float[Tensor, "k"]) -> Float[Tensor, "*n"]:
    """Compute the paper's approximate bin centre, sum_i y_i B_i, which is wrong where angles wrap around."""
    return weights @ bin_centres


def circular_mean(
    weights: Float[Tensor, "*n k"], bin_centres: Float[Tensor, "k"], smallest_resultant: float = 0.1
) -> Float[Tensor, "*n"]:
    """Compute the direction, in [0, 2 pi), of the sum of the unit vectors at angles B_k, weighted by y_k.

    It is equivariant under shifts of the bins. Its derivative is proportional to one over the length of that resultant,
    without bound if opposite bins mix in equal parts, so the derivative takes the length as at least
    ``smallest_resultant``. The value is exact.
    """
    sine, cosine = weights @ bin_centres.sin(), weights @ bin_centres.cos()
    squared = (sine.square() + cosine.square()).detach().clamp_min(smallest_resultant**2)
    value = torch.atan2(sine, cosine).detach() % (2.0 * math.pi)
    slope = (cosine.detach() * sine - sine.detach() * cosine) / squared
    return value + (slope - slope.detach())


def nearest_bin(angle: Float[Tensor, "*n"], bins: int, low: float, high: float) -> Int[Tensor, "*n"]:
    """Find the index of the bin of [low, high) that contains ``angle`` modulo the range."""
    fraction = ((angle.detach() - low) / (high - low)) % 1.0
    return (fraction * bins).long().clamp_max(bins - 1)
