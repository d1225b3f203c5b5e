"""Methods that learn psi from rewards, and the settings of all other methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import SceneDraw

Draws = Sequence[SceneDraw]
"""The scenes drawn from an asked psi, object by object."""


class Search(Protocol):
    """A run of such a method: ``ask`` for psi, train a detector on its images, ``tell`` the reward."""

    @property
    def psi(self) -> Float[Tensor, "objects K"]:
        """The method's current result."""
        ...

    def ask(self) -> Float[Tensor, "objects K"]:
        """The psi whose images come next."""
        ...

    def tell(self, reward: float, draws: Draws) -> None:
        """The reward of a detector trained on images of the psi last asked for; larger is better."""
        ...


class RewardMethod(Protocol):
    """A configured method. Each outer iteration of the budget has ``rounds`` of drawing, training and reward.

    ``explores``: the method needs a density of its draws, so that lights are drawn around psi's.
    """

    explores: ClassVar[bool]
    name: str
    rounds: int

    def begin(
        self, distribution: SceneDistribution, psi: Float[Tensor, "objects K"], generator: torch.Generator
    ) -> Search:
        """Start at ``psi``."""
        ...


@dataclass(frozen=True)
class Fixed:
    """No optimisation: images from the initial distribution (``ns``, the paper's NS) or the target's (``oracle``)."""

    name: str
    which: Literal["initial", "target"]

    def __post_init__(self) -> None:
        if self.which not in ("initial", "target"):
            raise ValueError(f"baseline.which must be initial or target, got {self.which!r}")


@dataclass(frozen=True)
class HypergradientLoop:
    """psi moves by the hypergradient with the configured estimator: Neural-Sim, or Auto-Sim with ``reinforce``."""

    name: str


@dataclass(frozen=True)
class Response:
    """psi moves by the measured response of training, without a derivative: a training for each bin, in which ``part``
    of every object's images moves to it (:mod:`outer.response`).
    """

    name: str
    part: float = 0.15

    def __post_init__(self) -> None:
        if not 0.0 < self.part <= 1.0:
            raise ValueError(f"baseline.part must lie in (0, 1], got {self.part}")


def positive(**values: float) -> None:
    """Raises ``ValueError`` for a value that is not positive, by its key."""
    for key, value in values.items():
        if not value > 0:
            raise ValueError(f"baseline.{key} must be positive, got {value}")
