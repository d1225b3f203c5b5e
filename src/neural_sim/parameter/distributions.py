"""Distributions over bins: those that the configuration names, their distance, and projections onto the simplex."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor

Specification = str | Mapping[str, object] | Sequence[float]
Biased = Mapping[str, Mapping[Literal["initial", "target"], Specification]]
"""Initial and target distributions of single objects, by object name."""

DOMINANT_REST = 0.02
"""Probability of a bin that is not a mode, for up to 25 bins. The paper (Sec. 4.2) only names the dominant bins; the
number comes from its authors' code and leaves 0.86 for one mode of eight bins, 0.44 for each of two and 0.3 for each of
three (github.com/gyhandy/Neural-Sim-NeRF, optimization/neural_sim_main.py)."""


def distribution(specification: Specification, bins: int, where: str = "distribution") -> Float[Tensor, "k"]:
    """Compute the probabilities of ``bins`` bins, float64, from a specification in the configuration.

    A specification is ``uniform``; ``{dominant: b}``, 0.02 on all bins except b, which has the rest (0.86 for k = 8);
    ``{modes: [b, ...]}``, 0.02 on all other bins, the rest split equally among the modes; or ``bins`` numbers that add
    up to 1. With more than 25 bins, 0.02 is replaced by 1 / (2 k). Bins are numbered from 1, as in the paper.

    Raises:
        ValueError: an unknown form, a bin outside 1..bins, a repeated mode, or numbers that are too few or too many,
            negative or not finite, or that do not add up to 1. The message begins with ``where``.
    """
    if specification == "uniform":
        return torch.full((bins,), 1.0 / bins, dtype=torch.float64)
    if isinstance(specification, Mapping):
        if set(specification) == {"dominant"}:
            return _peaked([specification["dominant"]], bins, where)
        if set(specification) == {"modes"} and isinstance(specification["modes"], Sequence):
            return _peaked(list(cast(Sequence[object], specification["modes"])), bins, where)
    elif not isinstance(specification, str) and isinstance(specification, Sequence):  # pyright: ignore[reportUnnecessaryIsInstance]
        return _numbers(specification, bins, where)
    raise ValueError(
        f"{where}: want uniform, {{dominant: b}}, {{modes: [b, ...]}} or {bins} numbers, got {specification!r}"
    )


def _peaked(modes: list[object], bins: int, where: str) -> Tensor:
    if not modes or len(set(modes)) != len(modes):
        raise ValueError(f"{where}: want one or more different bins, got {modes}")
    for mode in modes:
        if isinstance(mode, bool) or not isinstance(mode, int) or not 1 <= mode <= bins:
            raise ValueError(f"{where}: bins are numbered 1 to {bins}, got {mode!r}")
    rest = min(DOMINANT_REST, 0.5 / bins)
    probabilities = torch.full((bins,), rest, dtype=torch.float64)
    index = torch.tensor([int(str(mode)) - 1 for mode in modes])
    probabilities[index] = (1.0 - rest * (bins - len(modes))) / len(modes)
    return probabilities


def _numbers(values: Sequence[float], bins: int, where: str) -> Tensor:
    if len(values) != bins:
        raise ValueError(f"{where}: want {bins} numbers, got {len(values)}")
    probabilities = torch.tensor([float(value) for value in values], dtype=torch.float64)
    if not torch.isfinite(probabilities).all() or (probabilities < 0).any():
        raise ValueError(f"{where}: probabilities must be finite and not negative, got {list(values)}")
    if abs(probabilities.sum().item() - 1.0) > 1e-6:
        raise ValueError(f"{where}: probabilities must add up to 1, got {probabilities.sum().item():.6g}")
    return probabilities


def merged(p: Float[Tensor, "*n k"], groups: Sequence[Sequence[int]]) -> Float[Tensor, "*n g"]:
    """Add up the probabilities within groups of bins, which are numbered from 1."""
    return torch.stack([p[..., [b - 1 for b in group]].sum(-1) for group in groups], -1)


def total_variation(p: Float[Tensor, "*n k"], q: Float[Tensor, "*n k"]) -> Float[Tensor, "*n"]:
    """Compute the total variation distance, half the L1 distance: 0 if p equals q, 1 if they are disjoint."""
    return 0.5 * (p - q).abs().sum(-1)


def project_sum(values: Float[Tensor, "*n k"], total: float = 1.0) -> Float[Tensor, "*n k"]:
    """Project onto the hyperplane ``sum(w) = total``; weights may have either sign.

    Raises:
        ValueError: there are no entries, or some are not finite.
    """
    _check_weights(values)
    return values - (values.mean(-1, keepdim=True) - total / values.shape[-1])


def project_simplex(values: Float[Tensor, "*n k"]) -> Float[Tensor, "*n k"]:
    """Project onto the simplex ``w >= 0, sum(w) = 1`` (Held, Wolfe and Crowder 1974).

    The nearest point is ``max(v - t, 0)`` for the one t at which it adds up to 1. As t lies at most 1 below the largest
    entry, only entries less than 1 below it matter, and only their differences from it. Nothing large is subtracted, so
    the result adds up to 1 within a few rounding errors, whatever the size of the entries. The projection is
    differentiable where the set of positive weights does not change: there the derivative is ``I - 1 1^T / m`` on that
    set of m weights.

    Raises:
        ValueError: there are no entries, or some are not finite.
    """
    _check_weights(values)
    below = (values - values.amax(-1, keepdim=True).detach()).clamp_min(-1.0)
    descending = below.sort(-1, descending=True).values
    count = torch.arange(1, values.shape[-1] + 1, dtype=values.dtype, device=values.device)
    thresholds = (descending.cumsum(-1) - 1.0) / count
    positive = (descending > thresholds).sum(-1, keepdim=True)
    return (below - thresholds.gather(-1, positive - 1)).clamp_min(0.0)


def _check_weights(values: Tensor) -> None:
    if values.ndim == 0 or values.shape[-1] == 0:
        raise ValueError(f"simplex: want at least one weight, got shape {tuple(values.shape)}")
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"simplex: weights must be finite, got {values.tolist()}")  # pyright: ignore[reportUnknownMemberType]
