"""Fit a scene's grid to photographs: the samples that count, the loss, and the optimiser's steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neural_sim.field.quadrature import PackedSamples, render_weights, sum_rays, transmittance
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.space import Frame, along_rays
from neural_sim.types import Rays

LEARNING_RATE = 0.2
WARM_RATE = 0.1
"""Learning rate of a warm start, low enough to keep what the first fit settled, such as a plain table top."""
FINAL_RATE = 0.1
GAIN_RATE = 0.01
"""Learning rate of the photographs' log gains."""
SMOOTHNESS = 0.01
"""Weight of the absorbed fractions' total variation in the loss."""
SMOOTHED = 16_384
"""Number of vertices at which each step evaluates the total variation."""
REACHED = 1e-3
"""Transmittance below which samples are dropped."""
MARK_EVERY = 16
"""Number of steps between two searches for empty cells."""


@dataclass(frozen=True)
class ScenePixels:
    """Pixels of all photographs with their rays in the capture's frame.

    ``photo`` is the index of each pixel's photograph. ``detail`` is how much the photograph changes between adjacent
    pixels; without such change, the depth is uncertain.
    """

    origins: Float[Tensor, "pixels 3"]
    directions: Float[Tensor, "pixels 3"]
    colours: Float[Tensor, "pixels 3"]
    photo: Int[Tensor, "pixels"]
    detail: Float[Tensor, "pixels"]

    def __len__(self) -> int:
        return len(self.photo)

    def rays(self, index: Int[Tensor, "some"] | slice, frame: Frame) -> Rays:
        """Return the rays of pixels, in the normalised frame."""
        return Rays(frame.into(self.origins[index]).float(), self.directions[index].float())


@dataclass(frozen=True)
class Visible:
    """The samples of rays that may contribute.

    ``samples.distance``, in [0, 1], is the place along a ray as a fraction of its lattice; ``samples.width`` is a
    contracted length.
    """

    samples: PackedSamples
    positions: Float[Tensor, "samples 3"]
    corners: Int[Tensor, "samples 8"]
    weights: Float[Tensor, "samples 8"]


@torch.no_grad()
def visible(grid: SceneGrid, rays: Rays, phase: Float[Tensor, "rays"], count: int) -> Visible:
    """Select, from ``count`` samples per ray, those in occupied cells that light reaches."""
    positions, width = along_rays(rays.origins, rays.directions, phase, count)
    kept = grid.in_occupied(positions)
    ray, number = kept.nonzero().unbind(1)
    starts = functional.pad(kept.sum(1).cumsum(0), (1, 0))
    width, positions, place = width[kept], positions[kept], (number + phase[ray]) / count
    samples = PackedSamples(ray, place, width, starts)
    corners, weights = grid.corners(positions)
    sigma = grid.density(grid.raw(corners, weights)[:, 0])
    lit = transmittance(sigma, samples) > REACHED
    before = functional.pad(lit.long().cumsum(0), (1, 0))
    samples = PackedSamples(ray[lit], place[lit], width[lit], before[starts])
    return Visible(samples, positions[lit], corners[lit], weights[lit])


def loss_of(
    grid: SceneGrid,
    seen: Visible,
    colours: Float[Tensor, "rays 3"],
    log_gain: Float[Tensor, "rays 3"],
    behind: Float[Tensor, "rays 3"],
    vertices: Int[Tensor, "some"],
) -> Float[Tensor, ""]:
    """Compute the mean squared error of colours, plus ``SMOOTHNESS`` times the total variation at some vertices.

    Each photograph has its own exposure, a factor exp(log_gain). Rays that pass the whole scene show the colour
    ``behind``; it is drawn at random in every step, which teaches the field to be opaque.
    """
    raw = grid.raw(seen.corners, seen.weights)
    weights = render_weights(grid.density(raw[:, 0]), seen.samples)
    summed = sum_rays(
        weights[:, None] * functional.pad(torch.sigmoid(raw[:, 1:]), (0, 1), value=1.0), seen.samples
    )
    error = summed[:, :3] * log_gain.exp() + (1.0 - summed[:, 3:]) * behind - colours
    return error.square().mean() + SMOOTHNESS * grid.variation(vertices)


@dataclass(frozen=True)
class Budget:
    """The budget of one fit: ``steps`` of ``batch_rays`` rays, and the final number of cells per side.

    The number of cells per side doubles to ``resolution`` after a third of the steps.
    """

    steps: int
    batch_rays: int
    resolution: int


@dataclass(frozen=True)
class Fitted:
    """A scene's field, and the logarithms of its photographs' exposures, whose mean is 0."""

    grid: SceneGrid
    log_gain: Float[Tensor, "photos 3"]


def fit(
    pixels: ScenePixels,
    frame: Frame,
    budget: Budget,
    generator: torch.Generator,
    start: SceneGrid | None = None,
) -> Fitted:
    """Fit the field of all photographs, from scratch or from a grid of half the budget's resolution."""
    photos = int(pixels.photo.max()) + 1
    rate = LEARNING_RATE if start is None else WARM_RATE
    grid = SceneGrid(budget.resolution // 2) if start is None else start
    log_gain = torch.zeros(photos, 3, requires_grad=True)
    grid.table.requires_grad_(True)
    optimiser = _optimiser(grid.table, rate, log_gain)
    order = torch.empty(0, dtype=torch.long)
    for step in range(budget.steps):
        if step == budget.steps // 3:
            grid = grid.refined()
            grid.table.requires_grad_(True)
            optimiser = _optimiser(grid.table, rate, log_gain)
        if step % MARK_EVERY == 0 and step:
            grid.mark()
        if len(order) < budget.batch_rays:
            order = torch.cat([order, torch.randperm(len(pixels), generator=generator)])
        index, order = order[: budget.batch_rays], order[budget.batch_rays :]
        phase, behind = (
            torch.rand(len(index), generator=generator),
            torch.rand(len(index), 3, generator=generator),
        )
        seen = visible(grid, pixels.rays(index, frame), phase, grid.samples)
        vertices = torch.randint(len(grid.table), (SMOOTHED,), generator=generator)
        # A factor common to all photographs is the field's own brightness.
        centred = log_gain - log_gain.mean(0)
        loss = loss_of(grid, seen, pixels.colours[index], centred[pixels.photo[index]], behind, vertices)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for group in optimiser.param_groups:
            group["lr"] = group["initial_lr"] * FINAL_RATE ** (step / budget.steps)
        optimiser.step()
    grid.table.requires_grad_(False)
    grid.mark()
    return Fitted(grid, (log_gain - log_gain.mean(0)).detach())


def _optimiser(table: Tensor, rate: float, log_gain: Tensor) -> torch.optim.Optimizer:
    groups = [(table, rate), (log_gain, GAIN_RATE)]
    return torch.optim.Adam(
        [{"params": [tensor], "lr": rate, "initial_lr": rate} for tensor, rate in groups],
        betas=(0.9, 0.99), eps=1e-8, fused=True,
    )  # fmt: skip
