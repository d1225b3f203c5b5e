"""The randomness of draws, apart from what it is applied to: drawn once, replayed in every pass (paper, Tool 2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class BinNoise:
    """Noise that selects the bins of n draws.

    ``offset``: uniform in [0, 1), for exact draws that are balanced over the bins, see
    :func:`~neural_sim.parameter.bins.balanced`; None: independent draws.
    """

    gumbel: Float[Tensor, "n k"]
    offset: float | None = None

    def select(self, index: Int[Tensor, "m"]) -> BinNoise:
        """Select the draws ``index``, which may repeat; not balanced, which is a property of all draws together."""
        return BinNoise(self.gumbel[index])


@dataclass(frozen=True)
class SceneNoise:
    """All randomness of n draws, drawn once and replayed in every pass (paper, Tool 2).

    ``bins`` selects each factor's bins. ``uniform`` in [0, 1) places each coordinate within its bin, or in its range
    where no factor draws it. ``light`` is standard normal, for lights drawn around psi's weights; None: the lights are
    psi's weights.
    """

    bins: Mapping[str, BinNoise]
    uniform: Mapping[str, Float[Tensor, "n"]]
    light: Float[Tensor, "n k"] | None = None

    def __len__(self) -> int:
        return self.uniform["phi"].shape[0]

    def select(self, index: Int[Tensor, "k"]) -> SceneNoise:
        """The draws ``index``, which may repeat."""
        bins = {name: part.select(index) for name, part in self.bins.items()}
        uniform = {name: values[index] for name, values in self.uniform.items()}
        return SceneNoise(bins, uniform, None if self.light is None else self.light[index])
