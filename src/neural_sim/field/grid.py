"""Density and colour features on a packed grid, with rows only for the vertices of occupied cells."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from neural_sim.field.base import RadianceField
from neural_sim.field.extinction import Extinction, Surface, sum_rows
from neural_sim.field.interpolation import (
    CORNERS,
    corner_weights,
    gather_weighted,
    interpolate,
    interpolate_for_training,
    trilinear_tangents,
    trilinear_weights,
)
from neural_sim.field.marching import SampleCollector, Wave, lookup, march
from neural_sim.field.occupancy import Occupancy, build_occupancy, crop, dilate, subdivide, vertices
from neural_sim.field.quadrature import PackedSamples, Span
from neural_sim.field.screen import coarse_centres, screen_span
from neural_sim.ranges import NonNegativeInt, Positive, validated
from neural_sim.types import PinholeCamera, Rays

EMPTY_DENSITY = -1e4
"""Raw density in the table's row for empty space, so low that its softplus is exactly 0."""


@validated
class GridField(RadianceField):
    """A trilinear field over occupied cells, with sigma = softplus(gain raw) / cell edge.

    A raw value therefore stands for the same optical depth across a cell, whatever the cell's size.

    ``features`` numbers at each vertex give the colour. With ``head_width`` 0, the first three pass through a sigmoid
    (no view dependence; a Lambertian object under a fixed light needs none); otherwise, a head with one hidden layer
    sees all of them and the viewing direction. ``step_cells`` is the quadrature's step in cells. ``initial_density`` is
    the argument of softplus in a new field; ``density_gain`` is the factor by which density learns faster than colour.
    A new field is one cell, the cube [-1, 1]^3; ``reset`` sets its occupancy.
    """

    def __init__(
        self,
        features: Annotated[int, Ge(3)] = 3,
        head_width: NonNegativeInt = 0,
        step_cells: Annotated[float, Gt(0), Le(2)] = 1.0,
        initial_density: float = -3.0,
        density_gain: Positive = 2.0,
    ) -> None:
        super().__init__()
        self.features, self.head_width = features, head_width
        self.step_cells, self.initial_density, self.density_gain = step_cells, initial_density, density_gain
        self.directed = head_width > 0
        mlp = (nn.Linear(features + 3, head_width), nn.SiLU(), nn.Linear(head_width, 3)) if head_width else ()
        self.head = nn.Sequential(*mlp) if head_width else None
        self.table = nn.Parameter(torch.zeros(1, 1 + features))
        saved = ("occupied", "origin", "cell")
        for name in (*saved, "index", "distance", "corners", "coarse"):
            self.register_buffer(name, torch.empty(0), persistent=name in saved)
        self.occupied: Tensor
        self.origin: Tensor
        self.cell: Tensor
        self.index: Tensor
        self.distance: Tensor
        self.corners: Tensor
        self.coarse: Tensor
        self.register_load_state_dict_pre_hook(_resize_to_state)
        self.reset(torch.ones(1, 1, 1, dtype=torch.bool), torch.full((3,), -1.0), 2.0)

    @override
    def settings(self) -> dict[str, object]:
        names = ("features", "head_width", "step_cells", "initial_density", "density_gain")
        return {name: getattr(self, name) for name in names}

    @property
    def occupancy(self) -> Occupancy:
        """The occupied cells, and the distances to them."""
        return Occupancy(self.origin, self.edge, self.index, self.distance)

    @property
    def step(self) -> float:
        """The quadrature's step in object radii."""
        return self.step_cells * self.edge

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GridField:
        """Move and cast like any module, but reject a dtype that cannot resolve positions within a cell."""
        # Half precision for colour alone would not pay either: decoding is 6 % of a render on a CPU.
        wanted = fn(self.table.detach()[:0]).dtype
        if wanted not in (torch.float32, torch.float64):
            raise ValueError(f"GridField: want float32 or float64, got {wanted}")
        return super()._apply(fn, recurse)

    @override
    def with_step(self, multiple: float) -> GridField:
        if multiple == 1.0:
            return self
        other = copy.copy(self)
        other.step_cells = self.step_cells * multiple
        return other

    def reset(self, occupied: Bool[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], cell: float) -> None:
        """Start over with these cells, ``initial_density`` as the argument of softplus, and features of 0."""
        coordinates = self._set_cells(occupied, origin, cell)
        table = self.table.new_zeros(len(coordinates) + 1, 1 + self.features)
        table[:, 0] = self.initial_density / self.density_gain
        table[-1, 0] = EMPTY_DENSITY
        self.table = nn.Parameter(table)

    @torch.no_grad()
    def keep(self, cells: Bool[Tensor, "cells"], refine: bool) -> None:
        """Drop the occupied cells that are not in ``cells``, except neighbours of those that stay.

        With ``refine``, the cells' edges are halved first, so that the margin of neighbours is thinner. The table is
        interpolated at the new vertices.
        """
        wanted, occupied, cell = torch.zeros_like(self.occupied), self.occupied, self.edge
        wanted[occupied] = cells
        if refine:
            wanted, occupied, cell = subdivide(wanted), subdivide(occupied), cell / 2.0
        occupied = occupied & (dilate(wanted.to(self.table.dtype)) > 0)
        occupied, origin = crop(occupied, self.origin, cell)
        before, table, old_cell, old_origin = self.occupancy, self.table, self.edge, self.origin
        corners = self.corners
        coordinates = self._set_cells(occupied, origin, cell)
        # A new vertex may lie on the boundary of old cells; it is interpolated in one of them that is occupied.
        local = (origin - old_origin + coordinates.to(table.dtype) * cell) / old_cell
        rows = _interpolate_from(local, before, corners, table)
        self.table = nn.Parameter(torch.cat([rows, table[-1:]]))

    def _set_cells(self, occupied: Tensor, origin: Tensor, cell: float) -> Int[Tensor, "vertices 3"]:
        occupied = occupied.to(self.table.device)
        occupancy = build_occupancy(occupied, origin.to(self.table), cell)
        corners, coordinates = vertices(occupancy, CORNERS)
        # The last row of corners points at the table's last row: empty space.
        self.corners = functional.pad(corners, (0, 0, 0, 1), value=len(coordinates))
        self.occupied, self.origin = occupied, occupancy.origin
        # Also kept as a number, because reading the saved buffer would make the host wait for the device.
        self.edge, self.cell = float(cell), torch.tensor(cell, dtype=torch.float64)
        self.index, self.distance = occupancy.index, occupancy.distance
        self.coarse, self.coarse_radius = coarse_centres(occupancy)
        return coordinates

    def raw(
        self, positions: Float[Tensor, "samples 3"], cells: Int[Tensor, "samples"] | None = None
    ) -> Float[Tensor, "samples channels"]:
        """Interpolate table rows. ``cells`` are the positions' cell numbers (-1: empty), if already known."""
        local = (positions - self.origin) / self.edge
        base = local.detach().floor()
        corners = self._corners_of(lookup(base, self.occupancy) if cells is None else cells)
        if self.training:
            weights = corner_weights(*(local - base).t().contiguous())
            return interpolate_for_training(self.table, corners, weights)
        return interpolate(self.table, corners, trilinear_weights(local - base))

    @torch.no_grad()
    def query_with_tangents(
        self,
        positions: Float[Tensor, "samples 3"],
        directions: Float[Tensor, "samples 3"],
        velocities: Float[Tensor, "m samples 3"],
        turns: Float[Tensor, "m samples 3"],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See the base class; without a head, derivatives are in closed form and cost little more than ``query``."""
        raw, raw_rates = self.raw_with_tangents(positions, velocities)
        sigma_rates = self.density_rates(raw, raw_rates)
        sigma, rgb = self.decode(raw, directions)
        if self.head is None:
            return sigma, rgb, sigma_rates, (rgb * (1.0 - rgb)) * raw_rates[..., 1:4]
        rgb_rates = [
            torch.func.jvp(lambda *at: self.decode(*at)[1], (raw, directions), (rate, turn))[1]
            for rate, turn in zip(raw_rates, turns, strict=True)
        ]
        return sigma, rgb, sigma_rates, torch.stack(rgb_rates)

    @torch.no_grad()
    def raw_with_tangents(
        self, positions: Float[Tensor, "samples 3"], velocities: Float[Tensor, "m samples 3"]
    ) -> tuple[Float[Tensor, "samples channels"], Float[Tensor, "m samples channels"]]:
        """Interpolate table rows, with m >= 0 derivatives for positions that move at ``velocities``."""
        local = (positions - self.origin) / self.edge
        base = local.floor()
        corners = self._corners_of(lookup(base, self.occupancy))
        if not len(velocities):
            raw = gather_weighted(self.table, corners, corner_weights(*(local - base).t().contiguous()))
            return raw, raw.new_zeros(0, *raw.shape)
        weights, rates = trilinear_tangents(local - base, velocities / self.edge)
        raw = gather_weighted(self.table, corners, weights)
        return raw, torch.stack([gather_weighted(self.table, corners, rate) for rate in rates])

    def density_rates(
        self, raw: Float[Tensor, "samples channels"], raw_rates: Float[Tensor, "m samples channels"]
    ) -> Float[Tensor, "m samples"]:
        """Return the derivatives of density for table rows that change at ``raw_rates``."""
        slope = torch.sigmoid(self.density_gain * raw[:, 0]) * (self.density_gain / self.edge)
        return slope * raw_rates[..., 0]

    def density(self, raw: Float[Tensor, "samples channels"]) -> Float[Tensor, "samples"]:
        """Return density sigma, per object radius, of table rows."""
        return functional.softplus(self.density_gain * raw[:, 0]) / self.edge

    def decode(
        self, raw: Float[Tensor, "samples channels"], directions: Float[Tensor, "samples 3"] | None
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        """Return density and colour of table rows; a field without view dependence needs no directions."""
        sigma = self.density(raw)
        if self.head is None:
            return sigma, torch.sigmoid(raw[:, 1:4])
        assert directions is not None
        return sigma, torch.sigmoid(self.head(torch.cat([raw[:, 1:], directions], -1)))

    @override
    def query(
        self, positions: Float[Tensor, "samples 3"], directions: Float[Tensor, "samples 3"]
    ) -> tuple[Float[Tensor, "samples"], Float[Tensor, "samples 3"]]:
        return self.decode(self.raw(positions), directions)

    @torch.no_grad()
    @override
    def sample(self, rays: Rays, termination: float) -> PackedSamples:
        return self.sample_cells(rays, termination, 0.5)[0]

    @torch.no_grad()
    def sample_cells(
        self, rays: Rays, termination: float, phase: Float[Tensor, "rays"] | float
    ) -> tuple[PackedSamples, Int[Tensor, "samples"]]:
        """Return ``sample`` with a lattice phase for each ray (see ``march``), and the cell number of each sample."""
        rays = Rays(rays.origins.detach(), rays.directions.detach())
        collector = SampleCollector(len(rays.origins), rays.origins)
        extinction = Extinction(len(rays.origins), termination, rays.origins)

        def visit(wave: Wave) -> Tensor:
            if termination <= 0.0:
                collector.add(wave)
                return torch.ones_like(wave.ray, dtype=torch.bool)
            _, reached, alive = extinction.enter(wave, self.density(self._raw_of(wave)) * self.step)
            collector.add(wave, reached)
            return alive

        march(rays, self.occupancy, self.step, phase, visit)
        return collector.finish(self.step)

    def trace(
        self, rays: Rays, termination: float, span: Span | None = None, skip_empty: bool = True,
        surface: Surface | None = None,
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:  # fmt: skip
        """See the base class; each sample is found, interpolated and composited once, wave by wave."""
        return self.trace_as(self.decode, self.directed, rays, termination, span, skip_empty, surface)

    @torch.no_grad()
    def trace_as(
        self, decode: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]], directed: bool, rays: Rays,
        termination: float, span: Span | None, skip_empty: bool, surface: Surface | None,
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays"]]:  # fmt: skip
        """Trace rays; ``decode`` turns table rows into density and colour, and needs directions if ``directed``."""
        colour = rays.origins.new_zeros(len(rays.origins), 3)
        extinction = Extinction(len(rays.origins), termination, rays.origins)

        def visit(wave: Wave) -> Tensor:
            directions = None
            if directed:
                directions = rays.directions.index_select(0, wave.ray.index_select(0, wave.row))
            sigma, rgb = decode(self._raw_of(wave), directions)
            optical = sigma * self.step
            depth, reached, alive = extinction.enter(wave, optical)
            if surface is not None:
                surface.enter(wave.ray.index_select(0, wave.row), wave.distance, self.step, depth, optical)
            weights = torch.exp(-depth) * -torch.expm1(-optical) * reached
            colour.index_add_(0, wave.ray, sum_rows(rgb, weights, wave))
            return alive

        march(rays, self.occupancy, self.step, 0.5, visit, span, skip_empty)
        return colour, extinction.opacity()

    @override
    def span(self, camera: PinholeCamera, camera_to_world: Float[Tensor, "4 4"], rows: range) -> Span:
        return screen_span(self.coarse, self.coarse_radius, camera, camera_to_world, rows)

    @property
    @override
    def reach(self) -> float:
        return float(self.coarse.norm(dim=0).amax()) + self.coarse_radius if self.coarse.numel() else 0.0

    def _corners_of(self, cells: Int[Tensor, "samples"]) -> Int[Tensor, "samples 8"]:
        return self.corners.index_select(0, torch.where(cells < 0, len(self.corners) - 1, cells))

    def _raw_of(self, wave: Wave) -> Float[Tensor, "k channels"]:
        """Return table rows at a wave's samples, without derivatives."""
        corners = self.corners.index_select(0, wave.cell)
        return gather_weighted(self.table, corners, corner_weights(*wave.fraction))


def _resize_to_state(field: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Give the field the cells of a saved state before its tensors are copied."""
    if isinstance(field, GridField):
        field.reset(state[prefix + "occupied"], state[prefix + "origin"], float(state[prefix + "cell"]))


def _interpolate_from(
    local: Float[Tensor, "vertices 3"], occupancy: Occupancy, corners: Tensor, table: Tensor
) -> Float[Tensor, "vertices channels"]:
    """Interpolate an old table at vertices, each within an occupied cell that contains or touches it."""
    result = table.new_zeros(len(local), table.shape[1])
    missing = torch.arange(len(local), device=local.device)
    for corner in CORNERS:
        nudge = (corner.to(local) - 0.5) * 1e-2
        here = local.index_select(0, missing)
        cell = lookup(here + nudge, occupancy)
        hit = (cell >= 0).nonzero()[:, 0]
        base = (here + nudge).floor().index_select(0, hit)
        weights = corner_weights(*(here.index_select(0, hit) - base).t().contiguous())
        rows = corners.index_select(0, cell.index_select(0, hit))
        result.index_copy_(0, missing.index_select(0, hit), gather_weighted(table, rows, weights))
        missing = missing[cell < 0]
    return result
