"""The interface of methods that learn psi from rewards, and the settings of methods that are implemented elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.product import SceneDistribution
from neural_sim.ranges import PositiveFraction, validated


class Search(Protocol):
    """A run of a method with rewards: ``ask`` for psi, train a detector on its images, ``tell`` the reward."""

    @property
    def psi(self) -> Float[Tensor, "objects K"]:
        """The method's current result."""
        ...

    def ask(self) -> Float[Tensor, "objects K"]:
        """Return the psi for the next training images."""
        ...

    def tell(self, reward: float) -> None:
        """Record the reward of a detector trained on images at the psi last asked for; larger is better."""
        ...

    def state(self) -> dict[str, Any]:
        """Return what the run has learned, without its generator, so that an interrupted run can resume."""
        ...

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a ``state``, directly after ``begin``."""
        ...


class RewardMethod(Protocol):
    """A configured method with rewards. For each outer iteration in the budget, it has ``rounds`` trainings."""

    name: str
    rounds: int

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Search:
        """Start at ``psi``."""
        ...


@validated
@dataclass(frozen=True)
class Fixed:
    """No optimisation: images from the initial distribution (``ns``, the paper's NS) or the target's (``oracle``)."""

    name: str
    which: Literal["initial", "target"]


@validated
@dataclass(frozen=True)
class HypergradientLoop:
    """Steps of psi along the hypergradient: Neural-Sim or, with ``gradient=reinforce``, Auto-Sim."""

    name: str


@validated
@dataclass(frozen=True)
class Response:
    """Steps of psi along the finite-difference response of training, without a derivative (``outer.response``).

    The response takes one training at psi and one for each bin of each factor, in which every object moves the
    fraction ``part`` of its images to that bin.
    """

    name: str
    part: PositiveFraction = 0.15
