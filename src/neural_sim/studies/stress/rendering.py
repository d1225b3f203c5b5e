"""Rendering at extremes of density, size and distance, against the Beer-Lambert law along a closed-form chord.

Constant density s over a length L of a ray gives the opacity 1 - exp(-s L). The grid takes one sample per step h of a
fixed lattice, so that it sees a length N h with |N h - L| <= h for every interval inside the object: the opacity lies
between those of L - h and L + h, and N h = L if the ends of the interval are on the lattice. Rounding: a table entry r
(the log of a small density) is accurate to eps |r| and a sum of N terms to N eps, relative to the optical depth; the
error of the opacity is no larger. The running sum over the samples of all rays is accurate to N eps of float64 times
the sum of their optical depths, each of which counts for at most 50.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim import cameras
from neural_sim.detector.cached_set import CachedSet
from neural_sim.field.base import PackedSamples
from neural_sim.field.quadrature import composite
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.hvp import gradient
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
    not_finite,
    opacity_of,
    outside,
    raw_density,
    rounding_of,
    running_sum,
    short,
    small_detector,
    worst,
)
from neural_sim.synthesis.compositing import boxes_from_opacity
from neural_sim.types import LabelledImages, PinholeCamera, Rays

OPAQUE = 1e8
DENSITIES = (0.0, 1e-6, 1e-3, 1.0, 1e3, OPAQUE)


@case
def slab_opacity(scope: Scope) -> Checks:
    """Render densities from 0 to 1e8 in a cube of edge 2 on the lattice, with errors relative to 1 - exp(-2 s)."""
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
    """Render the unit sphere with the network, whose samples partition the chord of a ray at any density.

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

    Its opacity is 1 - exp(-0.5) at any density of the others, up to rounding of the running sum and of its own 20
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


# --- whole images and detector targets, against pinhole geometry and the rounding of bfloat16 ---


def beside(distance: float) -> Tensor:
    """Place a camera on world +x that looks at the origin."""
    values = (torch.tensor([value], dtype=DOUBLE) for value in (math.pi / 2, 0.0, distance))
    return cameras.orbit(*values).float()


def boxed(label: str, opacity: Tensor, expected: list[float], margin: float, wanted: str = "BOX") -> Check:
    """Check the box around the opaque pixels, whose edges may be off by ``margin``."""
    boxes, present = boxes_from_opacity(opacity)
    status = "BOX" if bool(present[0]) else "NO_BOX"
    return Check(f"box: {label}", worst(boxes[0, 0] - torch.tensor(expected)), margin, status, (wanted,))


@case
def one_pixel_object(scope: Scope) -> Checks:
    """Render an object half a pixel wide: at the centre of 33 pixels it fills one of them, with a box of 1 x 1.

    At the centre of 32 pixels it lies between four of them, every ray misses it, and there is no box.
    """
    field = block(OPAQUE, half=0.1)
    for size, expected, wanted in ((33, [16.0, 16.0, 17.0, 17.0], "BOX"), (32, [0.0] * 4, "NO_BOX")):
        camera = PinholeCamera(size, size, math.radians(40.0))
        distance = 0.1 * cameras.focal_length(camera) / 0.25  # a half-width of a quarter of a pixel
        _, opacity = EXACT.render(field, camera, beside(distance))
        yield boxed(f"{size} x {size} pixels", opacity, expected, 0.0, wanted)


@case
def wide_object(scope: Scope) -> Checks:
    """Render a cube in an image 2,000 pixels wide, so near that it covers all of it and so far that its edges are seen.

    The front face at distance d - a has edges f a / (d - a) pixels from the middle. A pixel's ray goes through its
    centre, half a pixel from its edge, and a ray that leaves through the side within one step of the edge may miss the
    cube: at slope a / (d - a), these are the outermost f h (a / (d - a)) / (d - a) pixels.
    """
    width, height, half = 2000, 400 if scope.full else 20, 0.5
    focal = 0.5 * width / math.tan(math.radians(20.0))
    camera = PinholeCamera(width, height, 2.0 * math.atan(0.5 * height / focal))
    field = block(OPAQUE, half=half, cells=32)
    for distance in (1.2, 2.5):
        _, opacity = NerfRenderer().render(field, camera, beside(distance))
        near = distance - half
        reach = focal * half / near
        covers = reach > 0.5 * width
        margin = 0.0 if covers else 1.0 + focal * field.step * (half / near) / near
        across, down = min(0.5 * width, reach), min(0.5 * height, reach)
        middle = (0.5 * width, 0.5 * height)
        expected = [middle[0] - across, middle[1] - down, middle[0] + across, middle[1] + down]
        yield boxed(f"distance {distance:g}, {width} x {height} pixels", opacity, expected, margin)
        if covers:
            yield Check(f"transparency: distance {distance:g}", worst(1.0 - opacity), eps(SINGLE))


@case
def zoom_ends(scope: Scope) -> Checks:
    """Draw and render both ends of distances, from just outside the unit sphere to 1e5 radii.

    A point at distance D is accurate to 2 eps D, so the chord of a ray is accurate to 4 eps D and a step.
    """
    for ends in ((2.4, 4.0), (1.0 + 1e-6, 1e5)):
        scene = SceneDistribution.of([Pose()], Unlearned(distance=ends))
        noise = scene.draw_noise(2, scope.generator(), DOUBLE)
        noise = SceneNoise(noise.bins, {**noise.uniform, "distance": torch.tensor([0.0, 1.0], dtype=DOUBLE)})
        draw = scene.hard(torch.zeros(8, dtype=DOUBLE), noise)
        gap = worst(draw.distance / torch.tensor(ends, dtype=DOUBLE) - 1.0)
        yield Check(f"distances drawn: {ends[0]:g} to {ends[1]:g}", gap, 4 * eps(DOUBLE))
    half = 0.55  # small enough that its corners, too, lie in the unit sphere
    for sigma in (1.0, OPAQUE):
        field = block(sigma, half=half)
        for distance in (1.0 + 1e-6, 2.4, 4.0, 1e3, 1e5):
            angle = 2.0 * math.atan(0.8 / distance) if distance > 2.0 else math.radians(40.0)
            bundle = cameras.rays(PinholeCamera(16, 16, angle), beside(distance))
            rays = Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
            _, opacity = EXACT.render_rays(field, rays)
            # The chord jumps where a ray passes an edge, so the cube is narrowed and widened by the error of a point.
            known = 2 * eps(SINGLE) * distance
            slack = field.step + 2 * known
            low, high = chord(rays, half - known) - slack, chord(rays, half + known) + slack
            quantity = f"opacity: distance {distance:g}, density {sigma:g}"
            yield Check(quantity, outside(opacity, sigma, low, high), rounding_of(sigma, SINGLE, 0.1375))


@case
def bfloat16(scope: Scope) -> Checks:
    """Render with bfloat16 (u = 2^-8): the table stored in it, and autocast, against float64.

    A raw value r is read to u |r| if it is stored, to 11 u |r| under autocast (entry and weight rounded, eight products
    summed in bfloat16 at worst, and the sum), its softplus to 2 u more. Opacity is monotone in r, so the bound is the
    closed-form opacity of r moved by that much, plus 4 u under autocast for alpha, transmittance, their product and
    sum. A colour is opacity times a sigmoid, whose slope is at most 1/4.
    """
    unit, colour, cell = 0.5 * eps(torch.bfloat16), 1.3, 0.25
    for sigma in (0.0, 1e-6, 1e-2, 0.3, 1.0, 3.0, 1e3, OPAQUE):
        double = block(sigma, DOUBLE, colour=colour)
        truth_rgb, truth = EXACT.render_rays(double, along_x((0.1, 0.2), dtype=DOUBLE))
        for label, relative, extra in (("stored", unit, 0.0), ("autocast", 11 * unit, 2 * unit)):
            field = block(sigma, colour=colour)
            if label == "stored":
                field.table.copy_(field.table.bfloat16())
            with torch.autocast("cpu", torch.bfloat16, enabled=label == "autocast"):
                rgb, opacity = EXACT.render_rays(field, along_x((0.1, 0.2)))
            raw = raw_density(sigma, cell)
            moved = torch.tensor([-1.0, 1.0], dtype=DOUBLE)
            depths = (
                8.0 * torch.nn.functional.softplus(raw + moved * relative * abs(raw)) * (1 + moved * extra)
            )
            bound = (
                worst(opacity_of(depths) - truth) + 32 * eps(SINGLE) + (4 * unit if extra and sigma else 0.0)
            )
            error = worst(opacity.double() - truth)
            yield Check(f"opacity: density {sigma:g}, {label}", error, bound)
            hue = float(truth) * (0.25 * relative * colour + extra)
            yield Check(f"colour: density {sigma:g}, {label}", worst(rgb.double() - truth_rgb), bound + hue)


@case
def extreme_boxes(scope: Scope) -> Checks:
    """Assign anchors to a box of one pixel, a box of one corner pixel, the whole image, and a sliver.

    Each box gets the anchor that overlaps it most (low-quality matches), and its encoding decodes to the same box. The
    gradient is finite and not zero, also without any box, when every anchor is background.
    """
    side = 32.0
    network = small_detector(3)
    params = {name: value.double() for name, value in network.init(scope.generator()).items()}
    backbone, head = network.split(params)
    pixels = torch.rand(1, 3, 32, 32, generator=scope.generator(), dtype=DOUBLE)
    cases = {
        "one pixel": [16.0, 16.0, 17.0, 17.0],
        "a corner pixel": [0.0, 0.0, 1.0, 1.0],
        "the whole image": [0.0, 0.0, side, side],
        "a sliver": [0.0, 15.0, side, 15.5],
        "none": [0.0, 0.0, 0.0, 0.0],
    }
    for label, entries in cases.items():
        box, number = torch.tensor(entries, dtype=DOUBLE), torch.tensor([[-1 if label == "none" else 1]])
        images = LabelledImages(pixels, box.view(1, 1, 4), number, torch.tensor([-1]))
        cached = CachedSet.of(network, backbone, images)
        claimed = cached.targets.labels[0] >= 0
        wrong = float(bool(claimed.any()) == (label == "none"))
        yield Check(f"anchors without a box, or a box without one: {label}", wrong, 0.0)
        slope = gradient(cached.mean_terms(), head)
        wrong = not_finite(slope) + float(slope.norm() == 0.0)
        yield Check(f"gradients not finite, or all zero: {label}", wrong, 0.0)
        if label == "none":
            continue
        anchors, deltas = network.anchors.double()[claimed], cached.targets.deltas[0, claimed]
        sides = anchors[:, 2:] - anchors[:, :2]
        centres = 0.5 * (anchors[:, 2:] + anchors[:, :2]) + deltas[:, :2] * sides
        halves = 0.5 * sides * deltas[:, 2:].exp()
        # The anchors' float32 numbers are exact in float64; coding and decoding round a handful of times.
        error = worst(torch.cat([centres - halves, centres + halves], -1) - box)
        yield Check(f"decoded box: {label}", error, 16 * eps(DOUBLE) * side)
