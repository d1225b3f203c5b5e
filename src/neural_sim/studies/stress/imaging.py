"""Whole images at extremes of size, distance and precision, and detector targets from a one-pixel box to a whole image.

References are pinhole geometry and the rounding of 8 bits.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim import cameras
from neural_sim.detector.cached_set import CachedSet
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
    block,
    case,
    chord,
    eps,
    not_finite,
    opacity_of,
    outside,
    raw_density,
    rounding_of,
    small_detector,
    worst,
)
from neural_sim.synthesis.compositing import boxes_from_opacity
from neural_sim.types import LabelledImages, PinholeCamera, Rays

OPAQUE = 1e8


def beside(distance: float) -> Tensor:
    """Place a camera on world +x that looks at the origin."""
    values = (torch.tensor([value], dtype=DOUBLE) for value in (math.pi / 2, 0.0, distance))
    return cameras.orbit(*values).float()


def boxed(label: str, opacity: Tensor, expected: list[float], margin: float, wanted: str = "BOX") -> Check:
    """Check the box around the opaque pixels."""
    boxes, present = boxes_from_opacity(opacity)
    status = "BOX" if bool(present[0]) else "NO_BOX"
    return Check(f"box: {label}", worst(boxes[0, 0] - torch.tensor(expected)), margin, status, (wanted,))


@case
def one_pixel_object(scope: Scope) -> Checks:
    """Render an object of half a pixel in front of the middle pixel of 33: exactly one pixel, a box of 1 x 1.

    Centred between four pixels of an image of 32, it is missed by every ray, and there is no box.
    """
    field = block(OPAQUE, half=0.1)
    for size, expected, wanted in ((33, [16.0, 16.0, 17.0, 17.0], "BOX"), (32, [0.0] * 4, "NO_BOX")):
        camera = PinholeCamera(size, size, math.radians(40.0))
        distance = 0.1 * cameras.focal_length(camera) / 0.25  # a half-width of a quarter of a pixel
        _, opacity = EXACT.render(field, camera, beside(distance))
        yield boxed(f"{size} x {size} pixels", opacity, expected, 0.0, wanted)


@case
def wide_object(scope: Scope) -> Checks:
    """Render a cube across an image 2,000 pixels wide: one that covers all of it, one whose edges are in sight.

    The front face at distance d - a has edges f a / (d - a) pixels from the middle. A pixel's ray is that of its centre
    (half a pixel), and a ray that leaves through the side within one step of the edge may be missed: at slope a / (d -
    a) that is the outermost f h (a / (d - a)) / (d - a) pixels, plus one where both meet.
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
    """Draw and render both ends of the distance, from just outside the unit sphere to 1e5 radii.

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
            # The chord itself jumps where a ray passes an edge: widen and narrow the cube by what a point is known to.
            known = 2 * eps(SINGLE) * distance
            slack = field.step + 2 * known
            low, high = chord(rays, half - known) - slack, chord(rays, half + known) + slack
            quantity = f"opacity: distance {distance:g}, density {sigma:g}"
            yield Check(quantity, outside(opacity, sigma, low, high), rounding_of(sigma, SINGLE, 0.1375))


@case
def bfloat16(scope: Scope) -> Checks:
    """Render with bfloat16 (u = 2^-8): the table stored in it, and autocast, against float64.

    A raw value r is read to u |r| where it is stored, to 11 u |r| under autocast (entry and weight rounded, eight
    products summed in bfloat16 at worst, and the sum), its softplus to 2 u more. Opacity is monotone in r: the bound is
    the opacity of r moved by that much, closed form, plus 4 u under autocast for alpha, transmittance, their product
    and sum. A colour is opacity times a sigmoid, whose slope is at most 1/4.
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

    Each box gets the anchor that overlaps it most (low-quality matches), its encoding decodes to the same box, and loss
    and gradient are finite. So they are without any box, when every anchor is background.
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
        # Anchors are in float32, exactly representable here; coding and decoding round a handful of times.
        error = worst(torch.cat([centres - halves, centres + halves], -1) - box)
        yield Check(f"decoded box: {label}", error, 16 * eps(DOUBLE) * side)
