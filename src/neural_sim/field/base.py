"""What a radiance field offers: densities and colours at points, and the distances worth asking for along rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from neural_sim.types import Rays


@dataclass(frozen=True)
class PackedSamples:
    """Samples of many rays without padding, sorted by ray and then by distance (the layout of nerfacc).

    ``ray`` numbers the ray of each sample; ``distance`` is along the ray's unit direction in object radii and
    ``width`` the length of ray the sample stands for. Ray r owns the samples ``starts[r]:starts[r + 1]``.
    """

    ray: Int[Tensor, "samples"]
    distance: Float[Tensor, "samples"]
    width: Float[Tensor, "samples"]
    starts: Int[Tensor, "rays_plus_one"]

    def __len__(self) -> int:
        return self.ray.shape[0]


class RadianceField(nn.Module, ABC):
    """Density and colour in the object's frame (unit sphere round the origin)."""

    @abstractmethod
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Density ``sigma`` (per object radius, at least 0) and colour in [0, 1].

        ``directions`` are unit and point away from the camera. Differentiable in both arguments, forward and
        reverse mode.
        """

    def query_with_tangents(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
    ) -> tuple[
        Float[Tensor, "samples"],
        Float[Tensor, "samples 3"],
        Float[Tensor, "m samples"],
        Float[Tensor, "m samples 3"],
    ]:
        """``query``, and its m >= 1 derivatives where positions move at ``velocities`` and directions at ``turns``.

        Here by Jacobian-vector products; a field that knows its own derivative overrides this.
        """
        values, rates = [], []
        for velocity, turn in zip(velocities, turns, strict=True):
            value, rate = torch.func.jvp(self.query, (positions, directions), (velocity, turn))[:2]
            values.append(value)
            rates.append(rate)
        sigma_rates, rgb_rates = (torch.stack(parts) for parts in zip(*rates, strict=True))
        return *values[0], sigma_rates, rgb_rates

    @abstractmethod
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        """The distances at which ``query`` is worth asking for rays of shape (rays, 3).

        Deterministic and detached: the same rays always give the same distances. Samples behind a transmittance
        below ``termination`` may be left out; 0 leaves nothing out.
        """

    @abstractmethod
    def settings(self) -> dict[str, object]:
        """The constructor's arguments, for ``save_field``."""
