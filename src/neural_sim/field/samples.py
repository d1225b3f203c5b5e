"""Samples along rays without padding, and the spans of distances that contain them."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

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

    def of_rays(self, first: int, last: int, begin: int, end: int) -> PackedSamples:
        """The samples of rays ``first`` to ``last`` - 1, numbered from 0; they are those from ``begin`` to ``end`` - 1.

        Both are ``starts`` of the rays. They are asked for, because reading them here would make the host wait for
        the device once a batch.
        """
        return PackedSamples(
            self.ray[begin:end] - first,
            self.distance[begin:end],
            self.width[begin:end],
            self.starts[first : last + 1] - begin,
        )


@dataclass(frozen=True)
class Span:
    """Distances between which each ray may meet something, in object radii; none where near > far."""

    near: Float[Tensor, "rays"]
    far: Float[Tensor, "rays"]

    def select(self, index: Int[Tensor, "some"]) -> Span:
        return Span(self.near.index_select(0, index), self.far.index_select(0, index))


def sample_points(
    rays: Rays, samples: PackedSamples
) -> tuple[Float[Tensor, "samples 3"], Float[Tensor, "samples 3"]]:
    """Positions and directions of the samples, differentiable in the rays; the distances are constants."""
    directions = rays.directions.index_select(0, samples.ray)
    origins = rays.origins.index_select(0, samples.ray)
    return origins + directions * samples.distance[:, None], directions
