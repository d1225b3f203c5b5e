"""Learning to Simulate (Ruiz, Schulter and Chandraker 2019): REINFORCE on the validation reward.

The policy is p_psi, an action is a whole training set, its reward what a detector trained on it scores on the target
set. One number is the reward of all objects and bins, so that thousands of rounds replace one hypergradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.base import Draws, Search
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.update import bound
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.types import SceneDraw


@validated
@dataclass(frozen=True)
class LearningToSimulate:
    """Ascent along ``(R - b) d log p(training set) / d psi`` with a moving average b of past rewards.

    The first reward has no baseline. psi stays until the second round; then each of the two rewards is the other's
    baseline (leave one out, unbiased), and psi steps along both.

    Args:
        name: in reports.
        learning_rate: logits a step at an advantage of one standard deviation of past rewards.
        decay: of the moving averages of the reward and of its square.
        max_step: largest change of a logit a step.
        rounds: training sets for each outer iteration of the budget; two take about as long as one hypergradient.
    """

    explores: ClassVar[bool] = True
    name: str = "lts"
    learning_rate: Positive = 0.5
    decay: Annotated[float, Ge(0), Lt(1)] = 0.8
    max_step: Positive = 1.0
    rounds: PositiveInt = 2

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Policy:
        """Make a policy that starts at ``psi``."""
        return Policy(self, distribution, psi.detach().clone())


class Policy(Search):
    """See :class:`LearningToSimulate`."""

    def __init__(
        self, settings: LearningToSimulate, distribution: SceneDistribution, psi: Float[Tensor, "objects K"]
    ) -> None:
        self._settings, self._distribution, self._psi = settings, distribution, psi
        self._mean, self._variance, self._told = 0.0, 0.0, 0
        self._first = torch.zeros_like(psi)  # the first round's score

    @property
    @override
    def psi(self) -> Float[Tensor, "objects K"]:
        return self._psi

    @override
    def ask(self) -> Float[Tensor, "objects K"]:
        return self._psi

    @override
    def tell(self, reward: float, draws: Draws) -> None:
        advantage = self._advantage(reward)
        slope = torch.stack(
            [score(self._distribution, psi, drawn) for psi, drawn in zip(self._psi, draws, strict=True)]
        )
        if self._told == 1:
            self._first = slope
            return
        if advantage == 0.0:
            return
        if self._told == 2:  # R_1 - R_2 is the first round's advantage, R_2 - R_1 the second's
            slope = slope - self._first
        # A sum of n scores has a standard deviation of order sqrt(n): divided out, so that the rate is in logits.
        size = max(len(draws[0]), 1) ** 0.5
        step = self._distribution.split(self._settings.learning_rate * advantage * slope / size)
        moved = {
            f.name: bound(*f.reach(step[f.name], self._settings.max_step)) for f in self._distribution.factors
        }
        self._psi = self._distribution.constrained(self._psi + self._distribution.join(moved))

    def _advantage(self, reward: float) -> float:
        """Compute ``R - b`` over the running standard deviation of rewards, then update b."""
        above, rest = reward - self._mean, 1.0 - self._settings.decay
        self._told += 1
        if self._told == 1:
            self._mean = reward
            return 0.0
        # The first difference is the only measure of spread so far.
        self._variance = above**2 if self._told == 2 else (1.0 - rest) * (self._variance + rest * above**2)
        self._mean += rest * above
        return above / self._variance**0.5 if self._variance > 0.0 else 0.0


def score(distribution: SceneDistribution, psi: Float[Tensor, "K"], draw: SceneDraw) -> Float[Tensor, "K"]:
    """Compute ``d log p(draws) / d psi`` of independent draws together."""
    leaf = psi.detach().requires_grad_()
    with torch.enable_grad():
        total = distribution.log_prob(leaf, draw).sum()
    return torch.autograd.grad(total, leaf)[0]
