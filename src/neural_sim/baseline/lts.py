"""Learning to Simulate (Ruiz, Schulter and Chandraker 2019): REINFORCE on the rewards of simulator settings.

The policy is a Gaussian over psi with a learned mean omega and fixed standard deviations. For each setting drawn from
it, one data set is rendered and one detector trained, whose score on the validation images is the setting's reward.
After every ``samples`` settings, omega steps along ``mean_k (R_k - b) d log pi(psi_k) / d omega`` (their Algorithm 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.base import Search
from neural_sim.parameter.product import SceneDistribution
from neural_sim.ranges import Positive, PositiveInt, validated


@validated
@dataclass(frozen=True)
class LearningToSimulate:
    """A Gaussian policy over psi, whose mean steps along the policy gradient times the policy's variance.

    Advantages R - b are divided by their running root mean square, so that steps depend neither on the unit of rewards
    nor on an offset.

    Args:
        name: name in reports.
        learning_rate: factor on steps, which are in standard deviations of the policy.
        deviation: standard deviation of the policy, in logits of bins.
        light_deviation: standard deviation of the policy, in weights of lights.
        samples: K, the number of settings for each step.
        decay: decay of the moving averages of rewards (b) and of squared advantages. In the first step, which has no
            earlier rewards, b is the mean over its own settings.
        rounds: number of settings for each outer iteration in the budget; two take about as long as one hypergradient.
    """

    name: str = "lts"
    learning_rate: Positive = 1.0
    deviation: Positive = 1.0
    light_deviation: Positive = 0.3
    samples: PositiveInt = 4
    decay: Annotated[float, Ge(0), Lt(1)] = 0.8
    rounds: PositiveInt = 2

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Policy:
        """Start a policy with the mean ``psi``."""
        return Policy(self, distribution, psi.detach().clone(), generator)


_LEARNED = ("omega", "noise", "rewards", "mean", "variance")


class Policy(Search):
    """A run of ``LearningToSimulate``."""

    def __init__(
        self,
        settings: LearningToSimulate,
        distribution: SceneDistribution,
        psi: Float[Tensor, "objects K"],
        generator: torch.Generator,
    ) -> None:
        self._settings, self._distribution, self._omega = settings, distribution, psi
        self._generator = generator
        own = {True: settings.light_deviation, False: settings.deviation}
        self._deviation = torch.cat(
            [psi.new_full((f.size,), own[f.lights > 0]) for f in distribution.factors]
        )
        self._noise: list[Float[Tensor, "objects K"]] = []
        self._rewards: list[Float[Tensor, ""]] = []
        self._mean: Float[Tensor, ""] | None = None
        self._variance: Float[Tensor, ""] | None = None

    @property
    @override
    def psi(self) -> Float[Tensor, "objects K"]:
        return self._omega

    @override
    def state(self) -> dict[str, Any]:
        return {name: getattr(self, f"_{name}") for name in _LEARNED}

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        for name in _LEARNED:
            setattr(self, f"_{name}", state[name])

    @override
    def ask(self) -> Float[Tensor, "objects K"]:
        noise = torch.randn(self._omega.shape, generator=self._generator, dtype=torch.float64).to(self._omega)
        self._noise.append(noise)
        # The policy gradient uses the density of the unprojected draw, because a projected one has no density.
        return self._distribution.constrained(self._omega + self._deviation * noise)

    @override
    def tell(self, reward: float) -> None:
        self._rewards.append(self._omega.new_tensor(reward))
        if len(self._rewards) < self._settings.samples:
            return
        advantages, noise = self._advantages(torch.stack(self._rewards)), torch.stack(self._noise)
        self._noise, self._rewards = [], []
        # d log pi / d omega is noise / deviation. Multiplied by the variance, it gives steps in units of the deviation.
        score = (advantages[:, None, None] * noise).mean(0)
        step = self._settings.learning_rate * self._deviation * score
        self._omega = self._distribution.constrained(self._omega + self._centred(step))

    def _advantages(self, rewards: Float[Tensor, "samples"]) -> Float[Tensor, "samples"]:
        """Compute ``R - b``, divided by its running root mean square, and update both averages."""
        mean, decay = rewards.mean(0), self._settings.decay
        before = mean if self._mean is None else self._mean
        above = rewards - before
        square = above.square().mean(0)
        self._mean = decay * before + (1.0 - decay) * mean
        self._variance = square if self._variance is None else decay * self._variance + (1.0 - decay) * square
        return torch.where(self._variance > 0.0, above / self._variance.sqrt(), 0.0)

    def _centred(self, step: Float[Tensor, "objects K"]) -> Float[Tensor, "objects K"]:
        """Subtract each factor's mean: p does not depend on it, and the weights of lights keep their sum."""
        parts = self._distribution.split(step)
        return self._distribution.join({n: part - part.mean(-1, keepdim=True) for n, part in parts.items()})
