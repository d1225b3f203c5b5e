"""The radiance field of the paper, NeRF's coarse and fine networks (Mildenhall et al. 2020), and their fitting."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor, nn
from typing_extensions import override

from neural_sim.cameras import unit_sphere_span
from neural_sim.field.base import RadianceField
from neural_sim.field.objective import Fitting, RayBlocks
from neural_sim.field.pool import build_pool
from neural_sim.field.quadrature import PackedSamples, composite, render_weights, sample_points
from neural_sim.field.rendering import render_samples
from neural_sim.field.scores import Rendering
from neural_sim.ranges import NonNegativeInt, Positive, PositiveInt, validated
from neural_sim.types import PosedViews, Rays

TwoOrMore = Annotated[int, Ge(2)]
SKIP_LAYER = 4
"""Index of the layer after which the encoded position enters again (NeRF, Fig. 7)."""


def positional_encoding(
    values: Float[Tensor, "samples 3"], frequencies: int
) -> Float[Tensor, "samples encoded"]:
    """Return the values, and sin and cos of 2^k pi times them for k < ``frequencies`` (NeRF, Eq. 4)."""
    scales = torch.pi * 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (values[:, None, :] * scales[:, None]).flatten(1)
    return torch.cat([values, angles.sin(), angles.cos()], -1)


class NerfNetwork(nn.Module):
    """Maps positions to density, and positions with directions to colour. The field's default sizes are NeRF's."""

    def __init__(self, width: int, depth: int, position_frequencies: int, direction_frequencies: int) -> None:
        super().__init__()
        self.position_frequencies, self.direction_frequencies = position_frequencies, direction_frequencies
        position, direction = 3 + 6 * position_frequencies, 3 + 6 * direction_frequencies
        inputs = [position] + [width + (position if layer == SKIP_LAYER else 0) for layer in range(depth - 1)]
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.sigma = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.colour = nn.Sequential(
            nn.Linear(width + direction, width // 2), nn.ReLU(), nn.Linear(width // 2, 3)
        )

    @override
    def forward(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        encoded = positional_encoding(positions, self.position_frequencies)
        hidden = encoded
        for layer, linear in enumerate(self.trunk):
            if layer == SKIP_LAYER + 1:
                hidden = torch.cat([encoded, hidden], -1)
            hidden = torch.relu(linear(hidden))
        # Softplus instead of NeRF's ReLU (as in mip-NeRF): a ReLU that is zero everywhere at first never learns.
        sigma = nn.functional.softplus(self.sigma(hidden)[:, 0])
        view = positional_encoding(directions, self.direction_frequencies)
        colour = self.colour(torch.cat([self.bottleneck(hidden), view], -1))
        return sigma, torch.sigmoid(colour)


@validated
class MLPField(RadianceField):
    """Two networks: the coarse one decides where along a ray the fine one is sampled.

    ``query`` uses the fine network. ``coarse_samples`` uniform samples span the ray's part in the unit sphere;
    ``fine_samples`` more are drawn in proportion to the coarse weights (NeRF, Sec. 5.2), at evenly spaced quantiles
    so that ``sample`` is deterministic. ``density_scale`` times softplus is the density per object radius.
    """

    def __init__(
        self,
        width: TwoOrMore = 256,
        depth: TwoOrMore = 8,
        position_frequencies: NonNegativeInt = 10,
        direction_frequencies: NonNegativeInt = 4,
        coarse_samples: TwoOrMore = 64,
        fine_samples: TwoOrMore = 128,
        density_scale: Positive = 10.0,
        seed: NonNegativeInt = 0,
    ) -> None:
        super().__init__()
        self._settings: dict[str, object] = {
            "width": width,
            "depth": depth,
            "position_frequencies": position_frequencies,
            "direction_frequencies": direction_frequencies,
            "coarse_samples": coarse_samples,
            "fine_samples": fine_samples,
            "density_scale": density_scale,
            "seed": seed,
        }
        self.coarse_samples, self.fine_samples, self.density_scale = (
            coarse_samples,
            fine_samples,
            density_scale,
        )
        self.coarse = NerfNetwork(width, depth, position_frequencies, direction_frequencies)
        self.fine = NerfNetwork(width, depth, position_frequencies, direction_frequencies)
        _initialise(self, torch.Generator().manual_seed(seed))

    @override
    def settings(self) -> dict[str, object]:
        return dict(self._settings)

    def with_step(self, multiple: float) -> MLPField:
        """See the base class; a longer step takes fewer samples in both passes, but at least two."""
        if multiple == 1.0:
            return self
        other = copy.copy(self)
        other.coarse_samples = max(2, round(self.coarse_samples / multiple))
        other.fine_samples = max(2, round(self.fine_samples / multiple))
        return other

    @override
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        sigma, rgb = self.fine(positions, directions)
        return sigma * self.density_scale, rgb

    def query_coarse(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Query the coarse network."""
        sigma, rgb = self.coarse(positions, directions)
        return sigma * self.density_scale, rgb

    @torch.no_grad()
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        """See the base class; skips nothing, whatever ``termination`` is: samples already follow the weights."""
        coarse = self.sample_coarse(rays, None)
        return self.sample_fine(rays, coarse, None)

    @torch.no_grad()
    def sample_coarse(self, rays: Rays, generator: torch.Generator | None) -> PackedSamples:
        """Return stratified distances in the unit sphere; without a generator, the middles of the strata."""
        near, far = unit_sphere_span(Rays(rays.origins.detach(), rays.directions.detach()))
        hit = (far > near).nonzero()[:, 0]
        near, far = near[hit, None], far[hit, None]
        edges = torch.linspace(0.0, 1.0, self.coarse_samples + 1, dtype=near.dtype, device=near.device)
        edges = near + (far - near) * edges
        place = _offsets((len(hit), self.coarse_samples), edges, generator)
        return _pack(edges[:, :-1] + place * edges.diff(dim=1), edges.diff(dim=1), hit, len(rays.origins))

    @torch.no_grad()
    def sample_fine(
        self, rays: Rays, coarse: PackedSamples, generator: torch.Generator | None
    ) -> PackedSamples:
        """Join the coarse distances with new ones, distributed in proportion to the coarse weights.

        Each sample represents the part of the ray around it. A ray has coarse_samples + fine_samples samples, or none
        if it misses the unit sphere.
        """
        sigma, _ = self.query_coarse(*sample_points(rays, coarse))
        weights = render_weights(sigma, coarse).view(-1, self.coarse_samples)
        middle, width = coarse.distance.view_as(weights), coarse.width.view_as(weights)
        low, total = middle[:, :1] - 0.5 * width[:, :1], width.sum(1, keepdim=True)
        edges = torch.cat([low, low + width.cumsum(1)], 1)
        even = (torch.arange(self.fine_samples, dtype=low.dtype, device=low.device)).expand(len(low), -1)
        quantiles = (even + _offsets(even.shape, low, generator)) / self.fine_samples
        fine = inverse_cumulative(edges, weights + 1e-5, quantiles)
        distance = torch.cat([middle, fine], 1).sort(dim=1).values
        between = 0.5 * (distance[:, 1:] + distance[:, :-1])
        bounds = torch.cat([edges[:, :1], between, edges[:, :1] + total], 1)
        hit = (coarse.starts.diff() > 0).nonzero()[:, 0]
        return _pack(distance, bounds.diff(dim=1).clamp_min(0.0), hit, len(rays.origins))


def inverse_cumulative(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays bins"],
    quantiles: Float[Tensor, "rays samples"],
) -> Float[Tensor, "rays samples"]:
    """Return the given quantiles of the density that is uniform between neighbouring ``edges``, with these weights."""
    cumulative = nn.functional.pad(weights.cumsum(1), (1, 0))
    cumulative = cumulative / cumulative[:, -1:]
    right = torch.searchsorted(cumulative, quantiles.contiguous(), right=True).clamp(1, weights.shape[1])
    left = right - 1
    start, end = cumulative.gather(1, left), cumulative.gather(1, right)
    fraction = ((quantiles - start) / (end - start).clamp_min(1e-12)).clamp(0.0, 1.0)
    low, high = edges.gather(1, left), edges.gather(1, right)
    return low + fraction * (high - low)


def _offsets(shape: torch.Size | tuple[int, int], like: Tensor, generator: torch.Generator | None) -> Tensor:
    if generator is None:
        return like.new_full(tuple(shape), 0.5)
    return torch.rand(shape, generator=generator, device=generator.device).to(like)


def _pack(distance: Tensor, width: Tensor, hit: Tensor, rays: int) -> PackedSamples:
    each = distance.shape[1]
    counts = torch.zeros(rays, dtype=torch.int64, device=distance.device)
    counts[hit] = each
    starts = nn.functional.pad(counts.cumsum(0), (1, 0))
    return PackedSamples(hit.repeat_interleave(each), distance.flatten(), width.flatten(), starts)


def _initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Draw He-uniform weights and zero biases (torch's own initialiser uses the global generator)."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            bound = (6.0 / layer.in_features) ** 0.5
            with torch.no_grad():
                layer.weight.copy_((torch.rand(layer.weight.shape, generator=generator) * 2.0 - 1.0) * bound)
                layer.bias.zero_()


@validated
class MLPFitting(Fitting):
    """Fits both networks at once (NeRF, Eq. 6), at random stratified sample distances.

    Rays of all pixels are used, because rays that miss the object show that the space around it is empty.
    """

    field: MLPField

    def __init__(
        self, field: MLPField, batch_rays: PositiveInt = 1024, learning_rate: Positive = 5e-4
    ) -> None:
        super().__init__(field, batch_rays)
        self.learning_rate = learning_rate

    @override
    def start(self, views: PosedViews, generator: torch.Generator) -> None:
        self._blocks = RayBlocks(build_pool(views, None, generator))
        self._generator = generator

    @override
    def render(self) -> tuple[list[Rendering], Float[Tensor, "rays 4"]]:
        batch = self._blocks.draw(self.batch_rays)
        coarse = self.field.sample_coarse(batch.rays, self._generator)
        fine = self.field.sample_fine(batch.rays, coarse, self._generator)
        sigma, rgb = self.field.query_coarse(*sample_points(batch.rays, coarse))
        return [composite(sigma, rgb, coarse), render_samples(self.field, batch.rays, fine)], batch.pixels

    @override
    def advance(self, step: int) -> bool:
        return False

    @override
    def state(self) -> dict[str, Any]:
        return {"field": self.field.state_dict(), "next": self._blocks.next}

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        self.field.load_state_dict(state["field"])
        self._blocks.next = state["next"]

    @override
    def learning_rates(self) -> list[tuple[list[torch.nn.Parameter], float]]:
        return [(list(self.field.parameters()), self.learning_rate)]
