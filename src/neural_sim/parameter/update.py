"""Optimisers of psi, whose steps can be bounded so that one noisy hypergradient cannot collapse p.

For bins, psi are logits and ``log_p`` [objects, k] is the factor's ``log_slopes``, log (p - floor); steps are in
logits. For lights, psi are weights and ``log_p`` is 0: steps are Euclidean, in units of the weights, and the
factor's ``project`` returns the result to its constraint (projected gradient descent; paper, Sec. 3.2). ``gradient``
and ``standard_error`` have psi's shape, in units of the outer loss over those of psi.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor

from neural_sim.ranges import Positive, validated

_log = logging.getLogger(__name__)

Momentum = Annotated[float, Ge(0), Lt(1)]
CLIP = 10.0
"""``Mirror`` limits a direction's root mean square to this many times the largest that its average has had so far."""


@dataclass(frozen=True)
class UpdateState:
    """State of an optimiser between steps.

    ``first`` is the momentum. For ``Mirror``, ``second`` is the largest mean square of its average so far, and
    ``noise`` the variance of ``first``. ``steps`` counts the steps that were taken, ``refused`` those that were refused
    because the gradient or the result was not finite; these change neither psi nor the momentum.
    """

    first: Float[Tensor, "objects k"]
    second: Float[Tensor, "objects k"]
    noise: Float[Tensor, "objects k"]
    steps: int = 0
    refused: int = 0

    @staticmethod
    def zeros(psi: Float[Tensor, "objects k"]) -> UpdateState:
        """Return the state before the first step."""
        return UpdateState(torch.zeros_like(psi), torch.zeros_like(psi), torch.zeros_like(psi))


def bound(step: Float[Tensor, "objects k"], largest: float) -> Float[Tensor, "objects k"]:
    """Centre a step, and scale it down for each object whose largest component exceeds ``largest``."""
    centred = step - step.mean(-1, keepdim=True)
    size = centred.abs().amax(-1, keepdim=True)
    return centred * (largest / size.clamp_min(largest))


def _accept(
    psi: Float[Tensor, "objects k"],
    moved: Float[Tensor, "objects k"],
    before: UpdateState,
    first: Float[Tensor, "objects k"],
    second: Float[Tensor, "objects k"],
    noise: Float[Tensor, "objects k"],
) -> tuple[Float[Tensor, "objects k"], UpdateState]:
    """Take a step, or refuse it if the result is not finite: a NaN would stay in the moments.

    Where the noise variance is not finite (an unknown standard error), the old one is kept for the same reason.
    """
    if all(bool(torch.isfinite(values).all()) for values in (moved, first, second)):
        noise = torch.where(torch.isfinite(noise), noise, before.noise)
        return moved, UpdateState(first, second, noise, before.steps + 1, before.refused)
    _log.warning("psi: refused a step because its gradient is not finite")
    return psi, replace(before, refused=before.refused + 1)


@validated
@dataclass(frozen=True)
class SGD:
    """Gradient descent with momentum (the paper: rate 1e-5 on its own loss scale, momentum 0.9).

    ``v <- momentum v + gradient``, ``psi <- psi - learning_rate v``. If ``max_step`` is None, steps are not bounded, as
    in the paper.
    """

    learning_rate: Positive
    momentum: Momentum = 0.9
    max_step: Positive | None = None

    def step(
        self, psi: Tensor, log_p: Tensor, gradient: Tensor, standard_error: Tensor, state: UpdateState
    ) -> tuple[Tensor, UpdateState]:
        """Compute psi after one step, and the state to pass to the next."""
        velocity = self.momentum * state.first + gradient
        step = -self.learning_rate * velocity
        moved = psi + (step if self.max_step is None else bound(step, self.max_step))
        return _accept(psi, moved, state, velocity, state.second, state.noise)


@validated
@dataclass(frozen=True)
class Mirror:
    """Mirror descent on the simplex with the entropy as mirror map (exponentiated gradient).

    In logits, the direction is the gradient with respect to p (that with respect to the logits, divided by p - floor),
    centred: a bin of small p takes as long a step as one of large p. Momentum averages the direction. The average is
    divided by the largest value so far of its root mean square over all objects and bins, so that ``learning_rate`` is
    in logits per step whatever the units of the loss, and steps shorten with the gradient. (A scale that decays would
    amplify the small gradients near the end, and objects without a gradient would drift.)

    With ``shrink``, each component of the average is multiplied by ``shrinkage`` (James and Stein 1961, positive part):
    components within their noise do not move. A component whose standard error is not finite is not shrunk.
    """

    learning_rate: Positive = 3.0
    momentum: Momentum = 0.6
    max_step: Positive = 3.0
    shrink: bool = True

    def step(
        self, psi: Tensor, log_p: Tensor, gradient: Tensor, standard_error: Tensor, state: UpdateState
    ) -> tuple[Tensor, UpdateState]:
        """Compute psi after one step, and the state to pass to the next."""
        steps, rest = state.steps + 1, 1 - self.momentum
        p = log_p.exp()
        drawn = p > 0.0  # closed bins have neither p nor a gradient, and do not move
        direction = torch.where(drawn, gradient / p, 0.0)
        mean = direction.sum(-1, keepdim=True) / drawn.sum(-1, keepdim=True)
        direction = torch.where(drawn, direction - mean, 0.0)
        clip = self._clip_factor(direction, state)
        velocity = self.momentum * state.first + rest * clip * direction
        noise = self.momentum**2 * state.noise + (rest * clip * standard_error / p).square()
        unbiased = velocity / (1 - self.momentum**steps)
        # Taken before shrinking: dividing by the shrunk norm would undo the shrinkage.
        largest = state.second.maximum(unbiased.square().mean())
        if self.shrink:
            unbiased = unbiased * shrinkage(velocity, noise)
        scale = largest.sqrt().clamp_min(torch.finfo(psi.dtype).tiny)
        moved = psi + bound(-self.learning_rate * unbiased / scale, self.max_step)
        return _accept(psi, moved, state, velocity, largest, noise)

    def _clip_factor(self, direction: Float[Tensor, "objects k"], state: UpdateState) -> Float[Tensor, ""]:
        """Compute the factor that scales an outlier down to ``CLIP`` times the scale, which never decreases."""
        size, known = direction.square().mean().sqrt(), state.second.max().sqrt()
        return torch.where(
            known > 0.0, (CLIP * known / size.maximum(known)).clamp_max(1.0), torch.ones_like(size)
        )


def shrinkage(
    direction: Float[Tensor, "objects k"], variance: Float[Tensor, "objects k"]
) -> Float[Tensor, "objects k"]:
    """Compute max(0, 1 - variance / direction^2); 1 where a variance is not finite, 0 where a direction is zero."""
    factors = 1.0 - variance / direction.square().clamp_min(torch.finfo(direction.dtype).tiny)
    factors = torch.where(direction == 0.0, torch.zeros_like(factors), factors.clamp(0.0, 1.0))
    return torch.where(torch.isfinite(variance), factors, torch.ones_like(factors))


Update = SGD | Mirror
