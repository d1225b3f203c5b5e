"""Search over distributions by the validation reward alone: at random, or by Bayesian optimisation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.baseline.base import Draws, positive
from neural_sim.parameter.product import SceneDistribution


class Incumbent(ABC):
    """The psi of the best reward so far. The first psi asked for is the initial one, the next are :meth:`propose`'s."""

    def __init__(self, psi: Float[Tensor, "objects K"]) -> None:
        self._best, self._asked, self._reward, self._told = psi, psi, -math.inf, 0

    @property
    def psi(self) -> Float[Tensor, "objects K"]:
        return self._best

    def ask(self) -> Float[Tensor, "objects K"]:
        self._asked = self._best if self._told == 0 else self.propose()
        return self._asked

    def tell(self, reward: float, draws: Draws) -> None:
        self._told += 1
        if reward > self._reward:
            self._best, self._reward = self._asked, reward

    @abstractmethod
    def propose(self) -> Float[Tensor, "objects K"]:
        """The next psi to try."""


@dataclass(frozen=True)
class RandomSearch:
    """p of every object and factor, and weights of lights, uniform over the simplex; the best reward is reported.

    Raises:
        ValueError: a number of rounds that is not positive.
    """

    explores: ClassVar[bool] = False
    name: str = "random_search"
    rounds: int = 2

    def __post_init__(self) -> None:
        positive(rounds=self.rounds)

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Incumbent:
        """A search whose first trial is ``psi``."""
        return _Random(distribution, psi.detach().clone(), generator)


class _Random(Incumbent):
    def __init__(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> None:
        super().__init__(psi)
        self._distribution, self._generator = distribution, generator

    def propose(self) -> Float[Tensor, "objects K"]:
        parts = {}
        for factor in self._distribution.factors:
            empty = torch.empty(len(self.psi), factor.size, dtype=torch.float64)
            spacings = empty.exponential_(generator=self._generator)
            p = spacings / spacings.sum(-1, keepdim=True)
            parts[factor.name] = factor.psi_of(p)
        return self._distribution.join(parts).to(self.psi)


@dataclass(frozen=True)
class BayesOpt:
    """Tree-structured Parzen estimators (Bergstra et al. 2011) over the logits, by Optuna's ask and tell.

    Every logit, and every weight of a light, is searched in [-``reach``, ``reach``], widened where necessary to contain
    the start. Optuna is imported only when a run begins.

    Raises:
        ValueError: a reach or number of rounds that is not positive.
    """

    explores: ClassVar[bool] = False
    name: str = "bayes_opt"
    reach: float = 3.0
    rounds: int = 2

    def __post_init__(self) -> None:
        positive(reach=self.reach, rounds=self.rounds)

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Incumbent:
        """A search whose first trial is ``psi``."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = optuna.samplers.TPESampler(seed=generator.initial_seed() % 2**32)
        study = optuna.create_study(direction="maximize", sampler=sampler)
        return _Bayes(self.reach, study, psi.detach().clone(), distribution)


class _Bayes(Incumbent):
    def __init__(
        self, reach: float, study: Any, psi: Float[Tensor, "objects K"], distribution: SceneDistribution
    ) -> None:
        super().__init__(psi)
        self._study, self._distribution = study, distribution
        start = {f"psi_{i}": value for i, value in enumerate(psi.flatten().tolist())}
        self._ranges = {name: (min(-reach, value), max(reach, value)) for name, value in start.items()}
        study.enqueue_trial(start)
        self._trial: Any = None
        self._values = psi

    def ask(self) -> Float[Tensor, "objects K"]:
        self._trial = self._study.ask()
        values = [self._trial.suggest_float(name, *ends) for name, ends in self._ranges.items()]
        self._values = torch.tensor(values, dtype=self.psi.dtype).view_as(self.psi)
        return super().ask()

    def propose(self) -> Float[Tensor, "objects K"]:
        return self._distribution.constrained(self._values)

    def tell(self, reward: float, draws: Draws) -> None:
        super().tell(reward, draws)
        self._study.tell(self._trial, reward)
