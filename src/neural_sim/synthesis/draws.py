"""How images are drawn from p_psi for an estimator."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neural_sim.parameter.product import SceneDistribution, SceneNoise


@dataclass(frozen=True)
class RelaxedDraws:
    """Draws that depend smoothly on psi, for the pathwise estimator.

    ``tangents``: also render the maps' derivatives by the numbers that depend on psi.
    """

    tangents: bool = False

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Randomness of ``count`` draws of one object."""
        return distribution.draw_noise(count, generator, dtype)


@dataclass(frozen=True)
class HardDraws:
    """Exact samples of p_psi, balanced over the bins. ``explore``: independent ones, and lights around psi's, for
    estimators that need the density of the draws together.
    """

    explore: bool = False

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Randomness of ``count`` draws of one object."""
        return distribution.draw_noise(
            count, generator, dtype, explore=self.explore, balanced=not self.explore
        )


Draws = HardDraws | RelaxedDraws
HARD = HardDraws()
