"""Whole images at the ends of size, distance and precision, by the geometry of the pinhole and rounding of 8
bits."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.stress.cases import Check, Checks, Scope, case, eps
from neural_sim.stress.rendering import EXACT, SINGLE, block, chord, opacity_of, raw_density
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.boxes import boxes_from_opacity
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import PinholeCamera, Rays

OPAQUE = 1e8


def beside(distance: float) -> Tensor:
    """A camera on world +x that looks at the origin."""
    values = (torch.tensor([value], dtype=torch.float64) for value in (math.pi / 2, 0.0, distance))
    return cameras.orbit(*values).float()


@case
def one_pixel_object(scope: Scope) -> Checks:
    """An object of half a pixel in front of the middle pixel of 33: exactly one pixel, a box of 1 x 1 along
    its edges; between four pixels of 32 no ray meets it and there is no box. The default smallest area, 16
    pixels, leaves both out.
    """
    field = block(OPAQUE, half=0.1)
    for size, expected in ((33, [16.0, 16.0, 17.0, 17.0]), (32, [0.0] * 4)):
        camera = PinholeCamera(size, size, math.radians(40.0))
        distance = 0.1 * cameras.focal_length(camera) / 0.25  # a half-width of a quarter of a pixel
        rgb, opacity = EXACT.render(field, camera, beside(distance))
        boxes, present = boxes_from_opacity(opacity)
        wanted = ("BOX",) if size == 33 else ("NO_BOX",)
        error = float((boxes[0, 0] - torch.tensor(expected)).abs().max())
        status = "BOX" if bool(present[0]) else "NO_BOX"
        yield Check(f"box in {size} x {size} pixels", error, 0.0, status, wanted)
        synthesizer = Synthesizer(ProceduralClutter(), shift=0.0)
        nuisance = synthesizer.draw_nuisance(1, camera, scope.generator())
        made = synthesizer.compose(rgb, opacity, nuisance, 0, torch.zeros(1, dtype=torch.long))
        boxed = float(made.present.sum())
        yield Check(f"boxes below the smallest area, {size} x {size} pixels", boxed, 0.0)
        values = float((~torch.isfinite(made.images)).sum())
        yield Check(f"pixels not finite, {size} x {size}", values, 0.0)


@case
def wide_object(scope: Scope) -> Checks:
    """A cube across an image 2,000 pixels wide: one that covers all of it, and one whose edges are in sight.

    The front face at distance d - a has edges f a / (d - a) pixels from the middle. A pixel's ray is that of
    its centre (half a pixel), and a ray that leaves through the side within one step of the edge may be
    missed: at slope a / (d - a) that is the outermost f h (a / (d - a)) / (d - a) pixels, plus one where both
    meet.
    """
    width, height = 2000, 400 if scope.full else 20
    focal = 0.5 * width / math.tan(math.radians(20.0))
    camera = PinholeCamera(width, height, 2.0 * math.atan(0.5 * height / focal))
    half, cells = 0.5, 32
    for distance in (1.2, 2.5):
        field = block(OPAQUE, half=half, cells=cells)
        _, opacity = NerfRenderer().render(field, camera, beside(distance))
        boxes, present = boxes_from_opacity(opacity)
        status = "BOX" if bool(present[0]) else "NO_BOX"
        near = distance - half
        reach = focal * half / near
        margin = 1.0 + focal * field.step * (half / near) / near
        covers = reach > 0.5 * width
        expected = [
            max(0.0, 0.5 * width - reach), max(0.0, 0.5 * height - reach),
            min(float(width), 0.5 * width + reach), min(float(height), 0.5 * height + reach),
        ]  # fmt: skip
        error = float((boxes[0, 0] - torch.tensor(expected)).abs().max())
        label = f"distance {distance:g}, {width} x {height} pixels"
        yield Check(f"box: {label}", error, 0.0 if covers else margin, status, ("BOX",))
        if covers:
            yield Check(f"transparency: {label}", float((1.0 - opacity).abs().max()), eps(SINGLE))


@case
def zoom_ends(scope: Scope) -> Checks:
    """Both ends of the distance: drawn exactly, and rendered right from just outside the unit sphere to 1e5
    radii.

    A point at distance D is known to 2 eps D, so that the chord of a ray is known to 4 eps D and a step.
    Beyond the lattice steps that the arithmetic can count, a camera is refused (it used to walk for ever).
    """
    for low, high in ((2.4, 4.0), (1.0 + 1e-6, 1e5)):
        scene = SceneDistribution.of([Pose()], Unlearned(distance=(low, high)))
        noise = scene.draw_noise(2, scope.generator(), torch.float64)
        ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
        noise = SceneNoise(noise.bins, {**noise.uniform, "distance": ends})
        draw = scene.hard(torch.zeros(8, dtype=torch.float64), noise)
        gap = float((draw.distance / torch.tensor([low, high], dtype=torch.float64) - 1.0).abs().max())
        yield Check(f"distances drawn: {low:g} to {high:g}", gap, 4 * eps(torch.float64))
    half = 0.55  # within the unit sphere to its corners
    for sigma in (1.0, OPAQUE):
        field = block(sigma, half=half)
        for distance in (1.0 + 1e-6, 2.4, 4.0, 1e3, 1e5):
            camera = PinholeCamera(
                16, 16, 2.0 * math.atan(0.8 / distance) if distance > 2.0 else math.radians(40.0)
            )
            bundle = cameras.rays(camera, beside(distance))
            rays = Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
            _, opacity = EXACT.render_rays(field, rays)
            slack = field.step + 4 * eps(SINGLE) * distance
            # The chord itself jumps where a ray passes an edge: widen and narrow the cube by what a point is known to.
            known = 2 * eps(SINGLE) * distance
            high, low = opacity_of(sigma * (chord(rays, half + known) + slack)), opacity_of(
                sigma * (chord(rays, half - known) - slack)
            )  # fmt: skip
            excess = torch.maximum(opacity.double() - high, low - opacity.double()).clamp_min(0.0)
            rounding = (abs(raw_density(sigma, 0.1375)) + 32) * eps(SINGLE)
            yield Check(f"opacity: distance {distance:g}, density {sigma:g}", float(excess.max()), rounding)
    try:
        EXACT.render(field, PinholeCamera(4, 4, 1e-7), beside(1e7))
        status = "rendered"
    except ValueError:
        status = "ValueError"
    yield Check("distance 1e7", float(status == "rendered"), 0.0, status, ("ValueError",))


@case
def bfloat16(scope: Scope) -> Checks:
    """Rendering with bfloat16 (8 bits of mantissa, so u = 2^-8): the table stored in it, and autocast,
    against float64.

    A raw value r is read to u |r| where it is stored, to 11 u |r| under autocast (entry and weight rounded,
    eight products summed in bfloat16 at worst, and the sum), its softplus to 2 u more. Opacity is monotone in
    r: the bound is the opacity of r moved by that much, closed form, plus 4 u under autocast for alpha,
    transmittance, their product and sum. A colour is opacity times a sigmoid, whose slope is at most 1/4.
    """
    unit = 0.5 * eps(torch.bfloat16)
    rays = Rays(torch.tensor([[3.0, 0.1, 0.2]]), torch.tensor([[-1.0, 0.0, 0.0]]))
    colour, cell = 1.3, 0.25
    for sigma in (0.0, 1e-6, 1e-2, 0.3, 1.0, 3.0, 1e3, OPAQUE):
        raw = raw_density(sigma, cell)
        double = Rays(rays.origins.double(), rays.directions.double())
        truth_rgb, truth = EXACT.render_rays(block(sigma, torch.float64, colour=colour), double)
        stored: GridField = block(sigma, colour=colour)
        stored.table.copy_(stored.table.bfloat16())
        for label, field, relative, extra in (
            ("stored", stored, unit, 0.0),
            ("autocast", block(sigma, colour=colour), 11 * unit, 2 * unit),
        ):
            with torch.autocast("cpu", torch.bfloat16, enabled=label == "autocast"):
                rgb, opacity = NerfRenderer(termination=0.0).render_rays(field, rays)
            move = relative * abs(raw)
            depths = [
                8.0 * math.log1p(math.exp(r)) if r < 30.0 else 8.0 * r for r in (raw - move, raw + move)
            ]
            ends = opacity_of(
                torch.tensor([depths[0] * (1 - extra), depths[1] * (1 + extra)], dtype=torch.float64)
            )
            bound = (
                float((ends - truth).abs().max()) + (4 * unit if extra and sigma else 0.0) + 32 * eps(SINGLE)
            )
            error = float((opacity.double() - truth).abs().max())
            yield Check(f"opacity: density {sigma:g}, {label}", error, bound)
            error = float((rgb.double() - truth_rgb).abs().max())
            hue = float(truth) * (0.25 * relative * colour + extra)
            yield Check(f"colour: density {sigma:g}, {label}", error, bound + hue)
