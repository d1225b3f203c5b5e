"""The score-function estimator (Williams 1992) with a leave-one-out baseline (Kool et al. 2019)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.gradient.base import MixedDerivative, from_contributions


def reinforce(
    scores: Float[Tensor, "n"],
    log_prob: Callable[[Float[Tensor, "K"]], Float[Tensor, "n"]],
    psi: Float[Tensor, "K"],
    weight: float = 1.0,
) -> MixedDerivative:
    """``weight * d/dpsi E[s]`` from n >= 2 independent draws: the mean of ``weight (s_i - b_i) dlog p(V_i)/dpsi``.

    ``b_i`` is the mean of the other draws' scores, hence independent of draw i: the estimate stays unbiased.
    ``log_prob`` maps psi to the draws' log-probabilities. Raises ``ValueError`` for fewer than 2 draws.
    """
    count = scores.numel()
    if scores.ndim != 1 or count < 2:
        raise ValueError(
            f"reinforce: a leave-one-out baseline wants at least 2 scores, got shape {tuple(scores.shape)}"
        )
    advantage = (scores - scores.mean()) * (count / (count - 1))
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        log_probabilities = log_prob(leaf)
    if log_probabilities.shape != scores.shape:
        raise ValueError(
            f"reinforce: got log-probabilities of shape {tuple(log_probabilities.shape)} for {count} scores"
        )
    slopes = [
        torch.autograd.grad(entry, leaf, retain_graph=True, materialize_grads=True)[0]
        for entry in log_probabilities
    ]
    return from_contributions(weight / count * advantage[:, None] * torch.stack(slopes))
