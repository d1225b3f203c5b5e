"""The derivative of an image with respect to its scene parameters: forward and reverse mode, patches, differences.

Every way computes the m numbers d<cotangent, image>/dV for a given cotangent that is nonzero in every pixel. Reverse
mode takes two renders and one backward pass (the paper's Tool 3), forward mode takes one render.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Ge, Le
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.field.rendering import render_samples
from neural_sim.gradient.pathwise import contract
from neural_sim.ranges import Positive, PositiveInt, validated
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World
from neural_sim.synthesis.motion import RIGID, pose_rates
from neural_sim.types import Maps, PinholeCamera, Rays, SceneDraw

MOST = 12
"""Number of entries of a pose that can change."""
Way = Callable[["Case"], Float[Tensor, "m"]]


@dataclass(frozen=True)
class Case:
    """One image, the m directions in which its camera moves, and the cotangent of its maps."""

    field: RadianceField
    renderer: NerfRenderer
    camera: PinholeCamera
    pose: Float[Tensor, "1 4 4"]
    rates: Float[Tensor, "m 1 4 4"]
    cotangent: Maps

    def double(self) -> Case:
        """Return the same in float64."""
        maps = Maps(self.cotangent.rgb.double(), self.cotangent.opacity.double())
        field = copy.deepcopy(self.field).double()
        return replace(self, field=field, pose=self.pose.double(), rates=self.rates.double(), cotangent=maps)

    def rays(self, moved: Float[Tensor, "m"], pixels: Tensor) -> Rays:
        """Return the rays of ``pixels`` after the camera moved by these amounts.

        Most of the moved matrices are not rotations; directions are kept at unit length.
        """
        pose = self.pose + torch.einsum("m,mnij->nij", moved, self.rates)
        rays = cameras.pixel_rays(self.camera, pose, pixels)
        return Rays(rays.origins, torch.nn.functional.normalize(rays.directions, dim=-1))


def case(field: RadianceField, renderer: NerfRenderer, size: int, numbers: int) -> Case:
    """Make a case whose directions are phi, rho and distance, then random ones in the twelve entries of the pose."""
    generator, device = torch.Generator().manual_seed(0), next(field.parameters()).device
    camera = PinholeCamera(size, size, math.radians(40.0))
    draw = SceneDraw(*(torch.tensor([x]) for x in (1.1, 0.4, 3.0)), bins=torch.zeros(1, 1, dtype=torch.long))
    rates = torch.randn(MOST, 1, 4, 4, generator=generator) * 0.3
    rates[:, :, 3] = 0.0
    rates[:3] = pose_rates(draw, RIGID)
    cotangent = torch.randn(1, size, size, 4, generator=generator).to(device)
    pose = cameras.orbit(draw.phi, draw.rho, draw.distance).to(device)
    maps = Maps(cotangent[..., :3], cotangent[..., 3])
    return Case(field, renderer, camera, pose, rates[:numbers].to(device), maps)


def forward(of: Case) -> Float[Tensor, "m"]:
    """Differentiate in forward mode, in the same pass as the render."""
    moved = of.renderer.render_with_tangents(of.field, of.camera, of.pose, of.rates)[1]
    return torch.cat(
        list(contract({str(i): tangent for i, tangent in enumerate(moved)}, of.cotangent).values())
    )


def reverse(of: Case, patch: int) -> Float[Tensor, "m"]:
    """Differentiate in reverse mode, ``patch`` rays at a time, after a render.

    Works like ``gradient.pathwise.draw_cotangents``, for a camera that moves linearly in any number of directions.
    """
    of.renderer.render(of.field, of.camera, of.pose)
    rgb, opacity = of.cotangent.rgb.reshape(-1, 3), of.cotangent.opacity.reshape(-1)
    total = of.pose.new_zeros(len(of.rates))
    for pixels in torch.arange(len(opacity), device=of.pose.device).split(patch):
        numbers = torch.zeros_like(total, requires_grad=True)
        rendered = of.renderer.render_rays(of.field, of.rays(numbers, pixels))
        (part,) = torch.autograd.grad(
            rendered, numbers, (rgb[pixels], opacity[pixels]), materialize_grads=True
        )
        total += part
    return total


@torch.no_grad()
def difference(of: Case, step: float, same: bool) -> Float[Tensor, "m"]:
    """Differentiate by central differences of full renders, two per direction.

    With ``same``, renders use the samples of the unmoved camera, as the derivatives do. Otherwise each render chooses
    its own samples, so that samples near the termination appear and vanish in jumps that no small step removes.
    """
    field = of.field.with_step(of.renderer.step)
    pixels = torch.arange(of.camera.width * of.camera.height, device=of.pose.device)
    rgb, opacity = of.cotangent.rgb.reshape(-1, 3), of.cotangent.opacity.reshape(-1)
    samples = field.sample(of.rays(of.pose.new_zeros(len(of.rates)), pixels), of.renderer.termination)
    found = []
    for moved in torch.eye(len(of.rates)).to(of.pose) * step:
        sides = []
        for sign in (1.0, -1.0):
            rays = of.rays(sign * moved, pixels)
            colour, alpha = (
                render_samples(field, rays, samples) if same else of.renderer.render_rays(of.field, rays)
            )
            sides.append((colour * rgb).sum() + (alpha * opacity).sum())
        found.append((sides[0] - sides[1]) / (2.0 * step))
    return torch.stack(found)


@validated
@dataclass(frozen=True)
class Derivative:
    """The family ``derivative``.

    Args:
        size: pixels per side.
        numbers: numbers m of camera parameters to differentiate by; one series each.
        patches: patch sizes in rays, for reverse mode.
        steps: steps of the central differences, in radians and object radii.
    """

    size: PositiveInt = 64
    numbers: tuple[Annotated[int, Ge(1), Le(MOST)], ...] = (1, 12)
    patches: tuple[PositiveInt, ...] = (64, 512)
    steps: tuple[Positive, ...] = (1e-2, 1e-4, 1e-6)

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure errors for the first object, relative to reverse mode on the whole image in float64."""
        del seed  # the camera and the cotangent are the same for all seeds
        for count in self.numbers:
            of = case(world.fields[0], world.renderer, self.size, count)
            precise = of.double()
            truth = reverse(precise, self.size**2)
            points = [
                self._point(name, line, one, way, truth, timing)
                for name, line, one, way in self.ways(of, precise)
            ]
            note = (
                f"One image of {self.size} x {self.size} pixels of {world.names[0]}, by {count} "
                f"number{'s' if count > 1 else ''} of its camera; float32, but for differences in float64. Against "
                "reverse mode of the whole image in float64."
            )
            yield Series(
                f"derivative/by {count}",
                "relative error of the derivative",
                tuple(points),
                (),
                note,
                timing.clock,
            )

    def ways(self, of: Case, precise: Case) -> Iterator[tuple[str, str, Case, Way]]:
        """Yield setting, line, the case in its precision, and the function that differentiates it."""
        yield "forward", "forward", of, forward
        chunks = replace(of, renderer=NerfRenderer(of.renderer.quality, rays_per_chunk=512))
        yield "forward, chunks of 512 rays", "forward", chunks, forward
        for patch in self.patches:
            if patch < self.size**2:
                yield f"reverse, patches of {patch}", "reverse", of, lambda one, p=patch: reverse(one, p)
        yield "reverse, whole", "reverse", of, lambda one: reverse(one, self.size**2)
        for line, one, same in (
            ("differences", of, True), ("differences in float64", precise, True),
            ("differences of new renders in float64", precise, False),
        ):  # fmt: skip
            for step in self.steps:
                yield f"{line}, {step:g}", line, one, lambda case, h=step, s=same: difference(case, h, s)

    def _point(self, name: str, line: str, of: Case, way: Way, truth: Tensor, timing: Timing) -> Point:
        error = float((way(of).double() - truth).norm() / truth.norm())
        seconds, memory = timing.of(lambda: way(of), of.pose.device)
        return Point(name, error, seconds, memory, name == "forward", line)
