"""Steps of the weights of lights, which stay on their constraint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.update import SGD, Mirror, UpdateState, check_rates


@dataclass(frozen=True)
class ProjectedGradient:
    """Gradient descent on weights, each step bounded and then projected on the constraint.

    Direction, momentum, scale and ``shrink`` are those of :class:`Mirror` under the Euclidean metric, its own at p = 1:
    ``learning_rate`` is in weights a step whatever the loss's units, and the common part of a gradient, which the
    constraint would take back, moves nothing. ``max_step`` bounds the largest change of a weight.
    """

    learning_rate: float = 0.6
    momentum: float = 0.6
    max_step: float = 1.0
    shrink: bool = True

    def __post_init__(self) -> None:
        check_rates(self.learning_rate, self.max_step, "outer.light_update", momentum=self.momentum)

    def _free(self) -> Mirror:
        return Mirror(self.learning_rate, self.momentum, self.max_step, self.shrink)

    def step(
        self,
        psi: Float[Tensor, "objects k"],
        gradient: Float[Tensor, "objects k"],
        standard_error: Float[Tensor, "objects k"],
        state: UpdateState,
        project: Callable[[Tensor], Tensor],
    ) -> tuple[Float[Tensor, "objects k"], UpdateState]:
        """Weights after one step, and the state to pass to the next; a gradient that is not finite moves neither."""
        moved, after = self._free().step(psi, torch.zeros_like(psi), gradient, standard_error, state)
        return project(moved), after


@dataclass(frozen=True)
class PlainProjectedGradient:
    """Projected gradient descent as it stands in books, with momentum: the paper's step of lights (Sec. 3.2).

    ``v <- momentum v + gradient``, ``psi <- project(psi - learning_rate v)``: no gradient's size is taken out, nothing
    is shrunk or bounded. ``learning_rate`` is in weights per unit of the gradient.

    Raises:
        ValueError: a rate that is not positive, a momentum outside [0, 1).
    """

    learning_rate: float
    momentum: float = 0.9

    def __post_init__(self) -> None:
        check_rates(self.learning_rate, None, "outer.light_update", momentum=self.momentum)

    def step(
        self,
        psi: Float[Tensor, "objects k"],
        gradient: Float[Tensor, "objects k"],
        standard_error: Float[Tensor, "objects k"],
        state: UpdateState,
        project: Callable[[Tensor], Tensor],
    ) -> tuple[Float[Tensor, "objects k"], UpdateState]:
        """Weights after one step, and the state to pass to the next; a gradient that is not finite moves neither."""
        free = SGD(self.learning_rate, self.momentum, max_step=None)
        moved, after = free.step(psi, torch.zeros_like(psi), gradient, standard_error, state)
        return project(moved), after


LightUpdate = ProjectedGradient | PlainProjectedGradient
