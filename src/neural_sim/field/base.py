"""What a radiance field offers: densities and colours at points, and the distances worth asking for along rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

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

    @abstractmethod
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        """The distances at which ``query`` is worth asking for rays of shape (rays, 3).

        Deterministic and detached: the same rays always give the same distances. Samples behind a transmittance
        below ``termination`` may be left out; 0 leaves nothing out.
        """

    @abstractmethod
    def settings(self) -> dict[str, object]:
        """The constructor's arguments, for ``save_field``."""
