"""How images are drawn from p_psi for an estimator."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neural_sim.parameter.factor import Relaxation
from neural_sim.parameter.noise import SceneNoise
from neural_sim.parameter.product import SceneDistribution


@dataclass(frozen=True)
class RelaxedDraws:
    """How images for the pathwise estimator are drawn.

    ``relaxation`` and ``conditional_draws`` (of ``gumbel_rao``): see :meth:`BinnedFactor.relaxed`. ``antithetic``:
    Gumbel noise in pairs from u and 1 - u. ``common_backgrounds``: the images of a pair share background and shift.
    ``tangents``: also render the maps' derivatives by the numbers that depend on psi.
    """

    relaxation: Relaxation = "gumbel_softmax"
    conditional_draws: int = 8
    antithetic: bool = False
    common_backgrounds: bool = False
    tangents: bool = False

    @property
    def group(self) -> int:
        """How many consecutive images share randomness."""
        return 2 if self.antithetic or self.common_backgrounds else 1

    @property
    def background_group(self) -> int:
        """How many consecutive images share a background."""
        return 2 if self.common_backgrounds else 1

    def noise(
        self, distribution: SceneDistribution, count: int, generator: torch.Generator, dtype: torch.dtype
    ) -> SceneNoise:
        """Raises ``ValueError`` for a count that does not divide into pairs where pairs are asked for."""
        if count % self.group:
            raise ValueError(
                "gradient.antithetic and gradient.common_backgrounds pair images: want an even "
                f"outer.images_per_object, got {count}"
            )
        conditional = self.conditional_draws if self.relaxation == "gumbel_rao" else 0
        return distribution.draw_noise(count, generator, dtype, self.antithetic, conditional)


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
