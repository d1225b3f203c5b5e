"""The mixture of bins that explains a sample: expectation maximisation, posterior draws and a test (pure functions).

A classifier trained on renders of equally frequent cells c (a bin of every factor) gives a box x the posterior
q(c | x), which is proportional to the likelihood p(x | c). Boxes of the target are a mixture p(x) = sum_c p_c p(x | c),
whose maximum-likelihood p is the fixed point of (Saerens, Latinne and Decaestecker 2002, equation 2.10)

    p_c <- mean_n r_n(c),    r_n(c) = p_c q(c | x_n) / sum_d p_d q(d | x_n).

Here p is a product of the factors' distributions, so each factor's p_c is updated with the marginals of the r_n, and a
Dirichlet prior adds ``prior`` boxes to every bin.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MORE = 5
"""Factor on the number of samples of a test that none of them reaches."""
Probabilities = tuple[Float[Tensor, "*batch _"], ...]
"""The probabilities of every factor's bins."""


class Status(enum.Enum):
    """How an expectation maximisation ended."""

    CONVERGED = "no probability changes by more than the tolerance"
    MAX_STEPS = "step budget spent: the likelihood is flat, so the bins cannot be told apart"


@dataclass(frozen=True)
class Mixed:
    """The mixture that was found.

    Attributes:
        p: probabilities of every factor's bins.
        log_likelihood: log-likelihood of the boxes, up to a constant.
        status: how the search ended.
    """

    p: Probabilities
    log_likelihood: Float[Tensor, "*batch"]
    status: Status


@dataclass(frozen=True)
class Cells:
    """The combinations of the factors' bins (``sizes``: how many each factor has); the last factor changes fastest."""

    sizes: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of combinations."""
        return int(np.prod(self.sizes))

    def joint(self, p: Probabilities) -> Float[Tensor, "*batch cells"]:
        """Multiply the factors' probabilities."""
        whole = p[0]
        for own in p[1:]:
            whole = (whole[..., :, None] * own[..., None, :]).flatten(-2)
        return whole

    def margins(self, counts: Float[Tensor, "*batch cells"]) -> Probabilities:
        """Sum the counts in every bin of each factor."""
        table = counts.unflatten(-1, self.sizes)
        first = counts.ndim - 1
        axes = range(first, first + len(self.sizes))
        return tuple(
            table.sum([axis for axis in axes if axis != own]) if len(axes) > 1 else table for own in axes
        )

    def bins(self, index: Int[Tensor, "n"]) -> tuple[Int[Tensor, "n"], ...]:
        """Return the bins of every factor in the given combinations."""
        return tuple(torch.unravel_index(index, self.sizes))

    def index(self, bins: Int[Tensor, "n factors"]) -> Int[Tensor, "n"]:
        """Return the indices of combinations of the given bins."""
        index = torch.zeros(len(bins), dtype=torch.long)
        for own, size in zip(bins.unbind(1), self.sizes, strict=True):
            index = index * size + own
        return index


def grouped(
    likelihood: Float[Tensor, "boxes cells"], cells: Cells, within: Sequence[Float[Tensor, "_ _"]]
) -> Float[Tensor, "boxes merged"]:
    """Merge bins that cannot be told apart.

    Args:
        likelihood: likelihood of each box in every cell.
        cells: the combinations of bins.
        within: for each factor, a matrix whose column g is the distribution over the bins of group g.

    Returns:
        The likelihood in every combination of groups.
    """
    table = likelihood.unflatten(-1, cells.sizes)
    for axis, matrix in enumerate(within, 1):
        table = (table.movedim(axis, -1) @ matrix.to(table)).movedim(-1, axis)
    return table.flatten(1)


def maximise(
    likelihood: Float[Tensor, "*batch boxes cells"],
    cells: Cells,
    prior: float,
    fixed: Mapping[int, Float[Tensor, "_"]] | None = None,
    steps: int = 1000,
    tolerance: float = 1e-7,
) -> Mixed:
    """Find the most probable mixture by expectation maximisation, starting from equal probabilities.

    Args:
        likelihood: likelihood of each box in every cell, up to a factor for each box; not negative, and for every box
            positive in at least one cell.
        cells: the combinations of bins.
        prior: number of boxes that the Dirichlet prior adds to every bin.
        fixed: given distributions, by the position of their factor.
        steps: largest number of steps.
        tolerance: largest change of a probability at which the search stops.
    """
    like = likelihood.double()
    batch, fixed = like.shape[:-2], fixed or {}
    p = tuple(
        fixed[i].double().expand(*batch, size) if i in fixed else like.new_full((*batch, size), 1.0 / size)
        for i, size in enumerate(cells.sizes)
    )
    status = Status.MAX_STEPS
    for _ in range(steps):
        counts = _expected(like, cells.joint(p))
        new = tuple(
            old if i in fixed else _normalised(own + prior)
            for i, (old, own) in enumerate(zip(p, cells.margins(counts), strict=True))
        )
        change = max(float((a - b).abs().max()) for a, b in zip(new, p, strict=True))
        p = new
        if change <= tolerance:
            status = Status.CONVERGED
            break
    return Mixed(p, log_likelihood(like, cells.joint(p)), status)


def log_likelihood(
    likelihood: Float[Tensor, "*batch boxes cells"], joint: Float[Tensor, "*#batch cells"]
) -> Float[Tensor, "*batch"]:
    """Compute the logarithm of the boxes' likelihood under a mixture."""
    return (likelihood * joint[..., None, :]).sum(-1).clamp_min(1e-300).log().sum(-1)


def _expected(like: Tensor, joint: Tensor) -> Float[Tensor, "*batch cells"]:
    weighted = like * joint[..., None, :]
    return (weighted / weighted.sum(-1, keepdim=True).clamp_min(1e-300)).sum(-2)


def _normalised(counts: Tensor) -> Tensor:
    return counts / counts.sum(-1, keepdim=True)


def posterior(
    likelihood: Float[Tensor, "*samples boxes cells"],
    cells: Cells,
    prior: float,
    generator: torch.Generator,
    chains: int = 100,
    burn: int = 40,
    kept: int = 10,
) -> Probabilities:
    """Draw mixtures from their posterior by Gibbs sampling: the boxes' cells given p, then p given the cells.

    The Dirichlet prior has the parameter ``prior``, so that, given the boxes' cells, the mean of p is the update of
    ``maximise``. (With ``prior`` + 1, that would be the mode, and a bin with nearly all boxes would get too little
    probability.) If the likelihood itself was estimated, the chains are divided among its ``samples``.

    Returns:
        ``chains`` x ``kept`` draws of every factor's probabilities, [draws, k].
    """
    like = likelihood.double()
    if like.ndim == 3:
        like = like[torch.arange(chains) * len(like) // chains]
    random = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
    p = tuple(like.new_full((chains, size), 1.0 / size) for size in cells.sizes)
    drawn: list[Probabilities] = []
    for step in range(burn + kept):
        weighted = (like * cells.joint(p)[:, None, :]).cumsum(-1)
        level = torch.from_numpy(random.random((chains, like.shape[-2]))) * weighted[..., -1]
        chosen = (weighted <= level[..., None]).sum(-1).clamp_max(cells.count - 1)
        counts = torch.zeros(chains, cells.count, dtype=torch.float64)
        counts.scatter_add_(1, chosen, torch.ones(chosen.shape, dtype=torch.float64))
        p = tuple(
            _normalised(torch.from_numpy(random.standard_gamma((own + prior).clamp_min(1e-3).numpy())))
            for own in cells.margins(counts)
        )
        if step >= burn:
            drawn.append(p)
    return tuple(torch.cat(own) for own in zip(*drawn, strict=True))


def ratio_test(
    likelihood: Float[Tensor, "boxes cells"],
    cells: Cells,
    null: Mapping[int, Float[Tensor, "_"]],
    known: tuple[Float[Tensor, "m cells"], Int[Tensor, "m"]],
    prior: float,
    draws: int,
    generator: torch.Generator,
) -> float:
    """Compute the p-value of the null hypothesis that some factors have given distributions, by parametric bootstrap.

    The statistic is twice the logarithm of the likelihood ratio. Its null distribution comes from samples of the
    ``known`` boxes, on which the classifier errs as it does on the target's. Each sample has as many boxes as the
    target, with cells drawn from the null (for other factors, from the best fit under it). If no sample reaches the
    target's statistic, there are ``MORE`` times as many, because a training's verdict is weighed against the p-value
    (``outer.trust_region``): one in 200 says too little of a ratio far beyond all samples.

    Args:
        likelihood: likelihood of each box in every cell.
        cells: the combinations of bins.
        null: the tested distributions, by the position of their factor.
        known: likelihoods of boxes of known cells, and these cells; every cell has at least one box.
        prior: see ``maximise``.
        draws: number of samples; the smallest p-value is 1 / (``MORE`` (``draws`` + 1)).
        generator: the source of all random numbers.
    """
    observed, under = _statistic(likelihood[None], cells, null, prior)
    joint = cells.joint(tuple(own[0] for own in under))
    known_likelihood, known_cells = known
    weights = joint[known_cells] / torch.bincount(known_cells, minlength=cells.count)[known_cells]

    def reaching(count: int, source: torch.Generator) -> int:
        rows = torch.multinomial(weights, count * len(likelihood), replacement=True, generator=source)
        drawn, _ = _statistic(known_likelihood[rows].view(count, *likelihood.shape), cells, null, prior)
        return int((drawn >= observed).sum())

    if reached := reaching(draws, generator):
        return (1 + reached) / (draws + 1)
    apart = generator.clone_state()  # so that later draws do not depend on the data
    every = MORE * (draws + 1) - 1
    return (1 + reaching(every - draws, apart)) / (every + 1)


def _statistic(
    likelihood: Tensor, cells: Cells, null: Mapping[int, Tensor], prior: float
) -> tuple[Float[Tensor, "batch"], Probabilities]:
    free = maximise(likelihood, cells, prior, tolerance=1e-5, steps=300)
    if len(null) == len(cells.sizes):
        p = tuple(null[i].double()[None] for i in range(len(null)))
        return 2.0 * (free.log_likelihood - log_likelihood(likelihood.double(), cells.joint(p))), p
    held = maximise(likelihood, cells, prior, null, tolerance=1e-5, steps=300)
    return 2.0 * (free.log_likelihood - held.log_likelihood), held.p
