"""Steps of psi from a hypergradient, bounded so that one noisy gradient cannot collapse p.

Of bins psi are logits and ``log_p`` their log probabilities. Of lights psi are weights and ``log_p`` is 0: the metric
of each step is then the Euclidean one, ``learning_rate`` and ``max_step`` are in weights, and the factor's ``project``
brings what a step gives back to the constraint (projected gradient descent, paper, Sec. 3.2).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

_log = logging.getLogger(__name__)

CLIFF = 10.0
"""The mirror step clips gradients to this many times its scale."""


@dataclass(frozen=True)
class UpdateState:
    """What an update carries between steps: moments of the direction, its noise variance, and the step count.

    ``refused`` counts gradients that were not finite, or whose square is not: they move neither psi nor the moments.
    """

    first: Float[Tensor, "objects k"]
    second: Float[Tensor, "objects k"]
    noise: Float[Tensor, "objects k"]
    steps: int = 0
    refused: int = 0

    @staticmethod
    def zeros(psi: Float[Tensor, "objects k"]) -> UpdateState:
        return UpdateState(torch.zeros_like(psi), torch.zeros_like(psi), torch.zeros_like(psi))


def check_rates(learning_rate: float, max_step: float | None, **rates: float) -> None:
    """Raises ``ValueError`` for a setting out of its range, with its key."""
    if not learning_rate > 0.0:
        raise ValueError(f"learning_rate must be positive, got {learning_rate}")
    if max_step is not None and not max_step > 0.0:
        raise ValueError(f"max_step must be positive, got {max_step}")
    for name, rate in rates.items():
        if not 0.0 <= rate < 1.0:
            raise ValueError(f"{name} must lie in [0, 1), got {rate}")


def bound(step: Float[Tensor, "objects k"], largest: float) -> Float[Tensor, "objects k"]:
    """The centred step, scaled down per object where its largest change of a logit exceeds ``largest``."""
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
    """The step with what it carries on, or none at all where a number of it is not finite: NaN would stay for ever.

    Noise that is not known (an infinite standard error) is not carried on either, for the same reason.
    """
    if all(bool(torch.isfinite(values).all()) for values in (moved, first, second)):
        noise = torch.where(torch.isfinite(noise), noise, before.noise)
        return moved, UpdateState(first, second, noise, before.steps + 1, before.refused)
    _log.warning("psi: a step from a gradient that is not finite was refused")
    return psi, replace(before, refused=before.refused + 1)


@dataclass(frozen=True)
class SGD:
    """Gradient descent with momentum (the paper: rate 1e-5 on its own loss scale, momentum 0.9).

    ``v <- momentum v + gradient``, ``psi <- psi - learning_rate v``; steps are as long as that says where ``max_step``
    is None, as in the paper.
    """

    learning_rate: float
    momentum: float = 0.9
    max_step: float | None = None

    def __post_init__(self) -> None:
        check_rates(self.learning_rate, self.max_step, momentum=self.momentum)

    def step(
        self, psi: Tensor, log_p: Tensor, gradient: Tensor, standard_error: Tensor, state: UpdateState
    ) -> tuple[Tensor, UpdateState]:
        """psi after one step, and the state to pass to the next."""
        velocity = self.momentum * state.first + gradient
        step = -self.learning_rate * velocity
        moved = psi + (step if self.max_step is None else bound(step, self.max_step))
        return _accept(psi, moved, state, velocity, state.second, state.noise)


@dataclass(frozen=True)
class Adam:
    """Adam (Kingma and Ba 2015) on the logits."""

    learning_rate: float = 0.3
    betas: tuple[float, float] = (0.8, 0.95)
    epsilon: float = 1e-12
    max_step: float = 0.5

    def __post_init__(self) -> None:
        check_rates(self.learning_rate, self.max_step, beta1=self.betas[0], beta2=self.betas[1])

    def step(
        self, psi: Tensor, log_p: Tensor, gradient: Tensor, standard_error: Tensor, state: UpdateState
    ) -> tuple[Tensor, UpdateState]:
        """psi after one step, and the state to pass to the next."""
        beta1, beta2 = self.betas
        steps = state.steps + 1
        first = beta1 * state.first + (1 - beta1) * gradient
        second = beta2 * state.second + (1 - beta2) * gradient.square()
        unbiased = first / (1 - beta1**steps)
        scale = (second / (1 - beta2**steps)).sqrt() + self.epsilon
        moved = psi + bound(-self.learning_rate * unbiased / scale, self.max_step)
        return _accept(psi, moved, state, first, second, state.noise)


@dataclass(frozen=True)
class Mirror:
    """Mirror descent on the simplex with the entropy as mirror map (exponentiated gradient).

    The step in the logits is the gradient with respect to p, which is the one in the logits over p (centred):
    a bin that p has left gets as long a step as one it favours. Momentum averages the direction; its scale is taken out
    by the largest root mean square over all objects and bins seen so far, so that ``learning_rate`` is in logits per
    step whatever the units of the loss, and steps shorten as the gradient does. (A scale that forgets would blow up
    what little gradient is left at the end, and the objects that have none to speak of would wander with it.)

    ``shrink`` scales each component of the averaged direction by max(0, 1 - its noise variance / its square), the
    positive-part rule of James and Stein (1961): what cannot be told from noise moves nothing, and the average of
    several iterations tells more than each of them. Standard errors that are not finite shrink nothing.
    """

    learning_rate: float = 3.0
    momentum: float = 0.6
    max_step: float = 3.0
    shrink: bool = True

    def __post_init__(self) -> None:
        check_rates(self.learning_rate, self.max_step, momentum=self.momentum)

    def step(
        self, psi: Tensor, log_p: Tensor, gradient: Tensor, standard_error: Tensor, state: UpdateState
    ) -> tuple[Tensor, UpdateState]:
        """psi after one step, and the state to pass to the next."""
        steps, rest = state.steps + 1, 1 - self.momentum
        p = log_p.exp()
        direction = gradient / p
        direction = direction - direction.mean(-1, keepdim=True)
        clipped = self._clipped(direction, state)
        velocity = self.momentum * state.first + rest * clipped * direction
        noise = self.momentum**2 * state.noise + (rest * clipped * standard_error / p).square()
        unbiased = velocity / (1 - self.momentum**steps)
        # Of all that was seen, noise as well: scaled by what is left of it, shrunk noise would be as long as before.
        largest = state.second.maximum(unbiased.square().mean())
        if self.shrink:
            unbiased = unbiased * told_from_noise(velocity, noise)
        scale = largest.sqrt().clamp_min(torch.finfo(psi.dtype).tiny)
        moved = psi + bound(-self.learning_rate * unbiased / scale, self.max_step)
        return _accept(psi, moved, state, velocity, largest, noise)

    def _clipped(self, direction: Float[Tensor, "objects k"], state: UpdateState) -> Float[Tensor, ""]:
        """The part of a direction that counts: the scale never falls, so one freak gradient must not set it."""
        size, known = direction.square().mean().sqrt(), state.second.max().sqrt()
        return torch.where(
            known > 0.0, (CLIFF * known / size.maximum(known)).clamp_max(1.0), torch.ones_like(size)
        )


def told_from_noise(
    direction: Float[Tensor, "objects k"], variance: Float[Tensor, "objects k"]
) -> Float[Tensor, "objects k"]:
    """max(0, 1 - variance / direction^2); 1 where a variance is not finite, 0 where a direction is zero."""
    kept = 1.0 - variance / direction.square().clamp_min(torch.finfo(direction.dtype).tiny)
    kept = torch.where(direction == 0.0, torch.zeros_like(kept), kept.clamp(0.0, 1.0))
    return torch.where(torch.isfinite(variance), kept, torch.ones_like(kept))


Update = SGD | Adam | Mirror
