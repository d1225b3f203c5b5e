"""Rendering at extremes of density, size and distance, against the Beer-Lambert law along a closed-form chord.

Constant density s over a length L of a ray gives the opacity 1 - exp(-s L). The grid takes one sample per step h of a
fixed lattice, so that it sees a length N h with |N h - L| <= h for every interval inside the object: the opacity lies
between those of L - h and L + h, and N h = L if the ends of the interval are on the lattice. Rounding: a table entry r
(the log of a small density) is accurate to eps |r| and a sum of N terms to N eps, relative to the optical depth; the
error of the opacity is no larger. The running sum over the samples of all rays is accurate to N eps of float64 times
the sum of their optical depths, each of which counts for at most 50.
"""

from __future__ import annotations

import torch

from neural_sim.field.base import PackedSamples
from neural_sim.field.quadrature import composite
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.studies.stress.cases import (
    DOUBLE,
    EXACT,
    SINGLE,
    Check,
    Checks,
    Scope,
    along_x,
    ball,
    block,
    case,
    chord,
    eps,
    opacity_of,
    outside,
    rounding_of,
    running_sum,
    short,
    worst,
)
from neural_sim.types import Rays

DENSITIES = (0.0, 1e-6, 1e-3, 1.0, 1e3, 1e8)


@case
def slab_opacity(scope: Scope) -> Checks:
    """Render densities from 0 to 1e8 through a cube of edge 2 on the lattice, against 1 - exp(-2 s), relatively."""
    for dtype in (DOUBLE, SINGLE):
        for sigma in DENSITIES:
            rgb, opacity = EXACT.render_rays(block(sigma, dtype), along_x((0.1, 0.2), dtype=dtype))
            truth = float(opacity_of(2.0 * sigma))
            error = abs(float(opacity) - truth) / truth if truth else float(opacity)
            label = f"density {sigma:g}, {short(dtype)}"
            yield Check(f"opacity: {label}", error, rounding_of(sigma, dtype))
            # A raw colour of 0 is 1/2 exactly.
            yield Check(f"colour: {label}", worst(rgb - 0.5 * opacity[:, None]), 2 * eps(dtype))


@case
def ball_opacity(scope: Scope) -> Checks:
    """Render the unit sphere with the network, whose samples partition the chord of a ray whatever the density.

    Rays start outside, start inside, or are almost tangent. Rounding: the near and far ends are accurate to a few eps
    of the distance, which the square root magnifies 1e3-fold for half a chord of 1e-3; 192 widths and the running sum
    add theirs.
    """
    distances = torch.tensor([0.0, 0.5, 0.999, 1.0 - 5e-7, 1.001], dtype=DOUBLE)
    half = (1.0 - distances.square()).clamp_min(0.0).sqrt()
    for dtype in (DOUBLE, SINGLE):
        slack = 3.0 * (192 + 1e3) * eps(dtype)
        for sigma in DENSITIES:
            for where, start, length in (("outside", 3.0, 2.0 * half), ("inside", 0.0, half)):
                rays = along_x(*[(float(d), 0.0) for d in distances], dtype=dtype, start=start)
                _, opacity = EXACT.render_rays(ball(sigma, dtype), rays)
                excess = outside(opacity, sigma, length - slack, length + slack)
                lost = running_sum(5 * 192, sigma * float(length.sum()))
                label = f"density {sigma:g} from {where}, {short(dtype)}"
                bound = 400 * eps(dtype) * min(1.0, 2 * sigma) + lost
                yield Check(f"opacity beyond rounding: {label}", excess, bound)


@case
def mixed_densities(scope: Scope) -> Checks:
    """Composite a faint ray packed after a thousand opaque ones.

    Its opacity is 1 - exp(-0.5) whatever the density of the others, up to rounding of the running sum and of its own 20
    samples.
    """
    rays, each, width = 1001, 20, 0.05
    for dtype in (DOUBLE, SINGLE):
        number = torch.arange(rays).repeat_interleave(each)
        widths = torch.full((rays * each,), width, dtype=dtype)
        starts = torch.arange(0, rays * each + 1, each)
        samples = PackedSamples(number, torch.zeros_like(widths), widths, starts)
        for sigma in (0.0, 1.0, 1e4, 1e8):
            sigmas = torch.full((rays, each), sigma, dtype=dtype)
            sigmas[-1] = 0.5
            _, opacity = composite(sigmas.flatten(), torch.zeros(rays * each, 3, dtype=dtype), samples)
            error = abs(float(opacity[-1]) - float(opacity_of(0.5 * each * float(widths[0]))))
            bound = running_sum(rays * each, rays * each * min(50.0, sigma * width)) + (each + 8) * eps(dtype)
            yield Check(f"opacity: behind density {sigma:g}, {short(dtype)}", error, bound)


@case
def thin_shell(scope: Scope) -> Checks:
    """Render walls half as thick as a step.

    A lattice may miss a wall, but the mean of N h over 64 equally spaced phases is that of a lattice 64 times as fine:
    within h / 64 of the length in each wall. At a single phase it is within h, and at the default step of one cell no
    wall is missed that a ray crosses fully.
    """
    half, cells, phases = 1.0, 8, 64
    targets = 0.7 * (2 * torch.rand(300, 3, generator=scope.generator(), dtype=DOUBLE) - 1.0)
    origins = 3.0 * torch.nn.functional.normalize(scope.normal(300, 3), dim=-1)
    rays = Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))
    length = chord(rays, half) - chord(rays, half - 2.0 * half / cells)
    field = block(1.0, DOUBLE, half, cells, step_cells=2.0, hollow=True)
    step, rounding = field.step, 64 * eps(DOUBLE)
    seen = torch.stack(
        [field.sample_cells(rays, 0.0, phase / phases)[0].starts.diff() * step for phase in range(phases)]
    )
    error = worst(seen.mean(0) - length)
    yield Check("mean length over 64 phases, step of 2 cells", error, 2 * step / phases + rounding)
    yield Check("length at any phase, step of 2 cells", worst(seen - length), 2 * step + rounding)
    for sigma in (1.0, 1e8):
        _, opacity = EXACT.render_rays(block(sigma, DOUBLE, half, cells, 2.0, hollow=True), rays)
        excess = outside(opacity, sigma, length - 2 * step, length + 2 * step)
        yield Check(f"opacity beyond its bounds: density {sigma:g}", excess, rounding)
    samples = block(1.0, DOUBLE, half, cells, hollow=True).sample(rays, 0.0)
    missed = float((samples.starts.diff() < 2).sum())
    yield Check("rays that miss a wall, step of 1 cell", missed, 0.0)


@case
def camera_inside(scope: Scope) -> Checks:
    """Render from inside the cube: correct within a step of the distance to its wall; early termination adds 1e-3."""
    for dtype in (DOUBLE, SINGLE):
        origins = (1.8 * torch.rand(500, 3, generator=scope.generator(), dtype=DOUBLE) - 0.9).to(dtype)
        rays = Rays(origins, torch.nn.functional.normalize(scope.normal(500, 3).to(dtype), dim=-1))
        length = chord(rays, 1.0)
        for sigma in DENSITIES:
            field, rounding = block(sigma, dtype), rounding_of(sigma, dtype)
            _, opacity = EXACT.render_rays(field, rays)
            label = f"density {sigma:g}, {short(dtype)}"
            excess = outside(opacity, sigma, length - field.step, length + field.step)
            yield Check(f"opacity beyond a step: {label}", excess, rounding)
            _, early = NerfRenderer().render_rays(field, rays)
            yield Check(f"early end: {label}", worst(early - opacity), 1e-3 + rounding)


@case
def grazing_rays(scope: Scope) -> Checks:
    """Render rays almost in the plane of a face, against the closed form within a step.

    On planes between cells every cell counts exactly once; exactly in the plane of a face either side is correct. Rays
    that miss the object see exactly 0, with derivatives of exactly 0.
    """
    slopes = (0.0, 1e-12, -1e-12, 1e-9, -1e-9, 1e-6, -1e-6, 1e-3, -1e-3)
    pairs = [(gap, slope) for gap in (1e-3, 1e-2, -1e-3) for slope in slopes]
    target = torch.tensor([(0.0, 1.0 - gap, 0.1) for gap, _ in pairs], dtype=DOUBLE)
    tilt = torch.tensor([[-1.0, slope, 0.0] for _, slope in pairs], dtype=DOUBLE)
    directions = torch.nn.functional.normalize(tilt, dim=-1)
    between = [(y, z) for y in (0.0, 0.25, -0.75) for z in (0.0, 0.5)]
    for dtype in (DOUBLE, SINGLE):
        rays = Rays((target - 3.0 * directions).to(dtype), directions.to(dtype))
        for sigma in (0.3, 1e8):
            field = block(sigma, dtype)
            _, opacity = EXACT.render_rays(field, rays)
            length = chord(rays, 1.0)
            excess = outside(opacity, sigma, length - field.step, length + field.step)
            label = f"density {sigma:g}, {short(dtype)}"
            yield Check(f"opacity beyond a step: {label}", excess, rounding_of(sigma, dtype))
        field, bound = block(0.3, dtype), rounding_of(0.3, dtype)
        _, opacity = EXACT.render_rays(field, along_x(*between, dtype=dtype))
        yield Check(f"opacity between cells, {short(dtype)}", worst(opacity - opacity_of(0.6)), bound)
        _, opacity = EXACT.render_rays(field, along_x((1.0, 0.1), (-1.0, 0.1), (0.1, 1.0), dtype=dtype))
        either = torch.minimum(opacity.abs(), (opacity - opacity_of(0.6)).abs())
        yield Check(f"opacity in the plane of a face, {short(dtype)}", worst(either), bound)
    origins = torch.tensor([[3.0, 1.5, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 3.0], [1e4, 1e4, 0.0]])
    away = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for label, field in (("grid", block(1e8, colour=3.0)), ("network", ball(1e8))):
        leaves = origins.clone().requires_grad_(), away.clone().requires_grad_()
        rgb, opacity = EXACT.render_rays(field, Rays(*leaves))
        total = rgb.sum() + opacity.sum()
        derivatives = torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
        yield Check(f"rays that miss, and their derivatives: {label}", worst(total, *derivatives), 0.0)
