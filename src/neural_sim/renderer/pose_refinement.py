"""Correct the camera poses of photographs so that the photographs agree on one field of the object.

Each round fits a small field at the current poses, then moves each camera by Gauss-Newton steps so that renders of the
field match its photograph: image alignment as in Lucas and Kanade (1981), against a radiance field. BARF (Lin et al.
2021) moves field and poses with a single optimiser instead.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from trimesh.registration import procrustes

from neural_sim.alpha import premultiplied
from neural_sim.cameras import resized
from neural_sim.field.base import RadianceField
from neural_sim.field.fitting import GridFitting
from neural_sim.field.grid import GridField
from neural_sim.field.hull import Resolution
from neural_sim.field.recipe import fit_field
from neural_sim.ranges import NonNegativeInt, PositiveInt, validated
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import Maps, PosedViews

_log = logging.getLogger(__name__)

FAIR = 0.1
"""Scale of Fair's robust loss (1974), in units of colour and opacity. Differences far above it, such as those from
highlights and passers-by, count in proportion to their size, those far below it in proportion to their square."""
DAMPING = 1e-3
"""Damping of the normal equations, relative to their diagonal (Marquardt 1963)."""
VIEWS_AT_ONCE = 16


@validated
@dataclass(frozen=True)
class PoseRefinement:
    """Corrects poses in rounds: each fits a small field, then moves the cameras by Gauss-Newton steps.

    Coarse fields correct cameras that are far off, but also shift correct ones. In the last third of the rounds,
    rounded down, fields have twice the resolution and twice the optimiser steps, and move these cameras back.

    Args:
        rounds: number of times a field is fitted; 0: the given poses are kept.
        updates: number of Gauss-Newton steps of each camera in a round.
        image_size: longer side in pixels to which larger views are reduced.
        resolution: number of cells along the unit sphere's diameter in the fields of the earlier rounds.
        steps: number of optimiser steps for each of these fields.
        batch_rays: number of rays in an optimiser step.
        seed: seed of the order of rays; separate from the run's seed, so that runs share the corrected views.
    """

    rounds: NonNegativeInt = 0
    updates: PositiveInt = 4
    image_size: Annotated[int, Ge(8)] = 96
    resolution: Resolution = 64
    steps: PositiveInt = 60
    batch_rays: PositiveInt = 4096
    seed: NonNegativeInt = 0

    def refine(self, views: PosedViews, held_out: int) -> PosedViews:
        """Return the views at corrected poses, including the last ``held_out``, to which no field is fitted.

        Photographs determine the cameras only up to a similarity that they share, which is chosen so that the cameras
        stay where they were on average.

        Raises:
            ValueError: as for ``visual_hull``, if the silhouettes share no cell.
        """
        if self.rounds == 0:
            return views
        reduced, given = reduce_views(views, self.image_size), views.camera_to_world
        poses, errors = given, []
        for number in range(self.rounds):
            reduced = replace(reduced, camera_to_world=poses)
            finer = 2 if 3 * number >= 2 * self.rounds else 1
            poses, error = align(self._field(reduced, held_out, finer), reduced, self.updates)
            errors.append(error)
        poses = onto(poses, given)
        shifted = (poses[:, :3, 3] - given[:, :3, 3]).norm(dim=-1)
        turned = rotation_angle(poses[:, :3, :3], given[:, :3, :3])
        _log.info(
            "%d cameras corrected by %.4f radii and %.2f degrees (medians; largest %.4f and %.2f); robust error of "
            "renders in each round: %s",
            len(views), float(shifted.median()), math.degrees(float(turned.median())), float(shifted.max()),
            math.degrees(float(turned.max())), ", ".join(f"{error:.5f}" for error in errors),
        )  # fmt: skip
        return replace(views, camera_to_world=poses)

    def _field(self, views: PosedViews, held_out: int, finer: int) -> RadianceField:
        steps = finer * self.steps
        fitting = GridFitting(
            GridField().to(views.images),
            finer * self.resolution,
            (),
            (steps // 2,),
            batch_rays=self.batch_rays,
        )
        generator = torch.Generator().manual_seed(self.seed)
        return fit_field(views, fitting, generator, steps=steps, held_out=held_out)[0]


def reduce_views(views: PosedViews, size: int) -> PosedViews:
    """Reduce views to a longer side of at most ``size`` pixels, by the mean over each pixel's area.

    A reduced pixel is known if all of its area is.
    """
    camera = views.camera
    factor = size / max(camera.width, camera.height)
    if factor >= 1.0:
        return views
    camera = resized(camera, max(1, round(factor * camera.width)), max(1, round(factor * camera.height)))
    shape = (camera.height, camera.width)
    channels = premultiplied(views.images).movedim(-1, 1)
    small = functional.adaptive_avg_pool2d(channels, shape).movedim(1, -1)
    colour = small[..., :3] / small[..., 3:].clamp_min(1e-6)
    known = views.known
    if known is not None:
        known = functional.adaptive_avg_pool2d(known[:, None].to(small), shape)[:, 0] > 1.0 - 1e-4
    return replace(views, images=torch.cat([colour, small[..., 3:]], -1), camera=camera, known=known)


def align(
    field: RadianceField, views: PosedViews, updates: int, renderer: NerfRenderer | None = None
) -> tuple[Float[Tensor, "views 4 4"], float]:
    """Take ``updates`` Gauss-Newton steps on Fair's loss of renders against views; return poses and their mean loss.

    Each camera gets the pose with the smallest loss among those it passed through, including the given one, so that no
    step that overshoots is kept.
    """
    # Coarse renders suffice here, and take two thirds of the time.
    renderer = renderer or NerfRenderer(termination=1e-2, step=2.0)
    parts = torch.arange(len(views)).split(VIEWS_AT_ONCE)
    results = [_align(field, views.select(part), updates, renderer) for part in parts]
    return torch.cat([poses for poses, _ in results]), float(torch.cat([loss for _, loss in results]).mean())


def _align(
    field: RadianceField, views: PosedViews, updates: int, renderer: NerfRenderer
) -> tuple[Float[Tensor, "views 4 4"], Float[Tensor, "views"]]:
    poses = best = views.camera_to_world
    least = poses.new_full((len(views),), math.inf, dtype=torch.float64)
    for update in range(updates + 1):
        last = update == updates
        if last:
            values, tangents = Maps(*renderer.render(field, views.camera, poses)), []
        else:
            values, tangents = renderer.render_with_tangents(field, views.camera, poses, pose_rates(poses))
        residual = _residuals(values, views)
        loss = fair_loss(residual).mean(-1)
        better = loss < least
        best, least = torch.where(better[:, None, None], poses, best), torch.where(better, loss, least)
        if not last:
            jacobian = torch.stack([_shown(_flat(tangent), views) for tangent in tangents], -1)
            poses = moved(poses, gauss_newton_step(jacobian, residual).to(poses))
    return best, least


def gauss_newton_step(
    jacobian: Float[Tensor, "views n 6"], residual: Float[Tensor, "views n"]
) -> Float[Tensor, "views 6"]:
    """Find the step that minimises the weighted sum of squares of residual - jacobian step, with damping.

    The weights come from Fair's loss (iteratively reweighted least squares). The step is zero for a camera whose
    image does not change with any motion.
    """
    weighted = jacobian / (1.0 + residual.abs() / FAIR)[..., None]
    normal = weighted.transpose(1, 2) @ jacobian
    size = normal.diagonal(dim1=1, dim2=2)
    floor = 1e-12 + 1e-9 * size.amax(-1, keepdim=True)
    damped = normal + torch.diag_embed(DAMPING * size + floor)
    return torch.linalg.solve(damped, (weighted.transpose(1, 2) @ residual[..., None]))[..., 0]


def fair_loss(residual: Tensor) -> Tensor:
    """Compute Fair's loss: r^2 / 2 for small residuals, c |r| for large ones."""
    ratio = residual.abs() / FAIR
    return FAIR**2 * (ratio - ratio.log1p())


def _residuals(values: Maps, views: PosedViews) -> Float[Tensor, "views n"]:
    """Return the views minus their renders, premultiplied."""
    alpha = views.images[..., 3:]
    shown = Maps(views.images[..., :3] * alpha, alpha[..., 0])
    return _shown(_flat(shown) - _flat(values), views)


def _shown(values: Float[Tensor, "views n"], views: PosedViews) -> Float[Tensor, "views n"]:
    """Return the values, 0 at pixels that a photograph does not show."""
    return values if views.known is None else values * views.known.flatten(1).repeat_interleave(4, 1)


def _flat(maps: Maps) -> Float[Tensor, "views n"]:
    return torch.cat([maps.rgb, maps.opacity[..., None]], -1).flatten(1).double()


def pose_rates(poses: Float[Tensor, "views 4 4"]) -> Float[Tensor, "6 views 4 4"]:
    """Differentiate ``moved`` by turns about a camera's own axes (1 / rad) and motions along them (1 / radius)."""
    rates = poses.new_zeros(6, *poses.shape)
    for axis, unit in enumerate(torch.eye(3, dtype=poses.dtype, device=poses.device)):
        rates[axis, :, :3, :3] = poses[:, :3, :3] @ _cross(unit)
        rates[3 + axis, :, :3, 3] = poses[:, :3, :3] @ unit
    return rates


def moved(poses: Float[Tensor, "views 4 4"], step: Float[Tensor, "views 6"]) -> Float[Tensor, "views 4 4"]:
    """Turn cameras by a rotation vector in radians and shift them in object radii, both along their own axes."""
    result = poses.clone()
    result[:, :3, :3] = poses[:, :3, :3] @ torch.linalg.matrix_exp(_cross(step[:, :3]))
    result[:, :3, 3] += (poses[:, :3, :3] @ step[:, 3:, None])[..., 0]
    return result


def _cross(vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the matrices that map v to vector x v."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = ([zero, -z, y], [z, zero, -x], [-y, x, zero])
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def rotation_angle(a: Float[Tensor, "*n 3 3"], b: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n"]:
    """Return the angle in radians between rotations, accurate for small angles, where arccos is not."""
    chord = (a - b).flatten(-2).norm(dim=-1) / math.sqrt(8.0)  # sine of half the angle
    return 2.0 * torch.asin(chord.clamp_max(1.0))


def onto(poses: Float[Tensor, "views 4 4"], given: Float[Tensor, "views 4 4"]) -> Float[Tensor, "views 4 4"]:
    """Move the poses by the least-squares similarity that takes their cameras to the given ones (Umeyama 1991).

    It is fitted to the cameras' positions and to the points one object radius away along each camera's axes, so that
    even one camera determines it.
    """
    matrix, _, _ = procrustes(_points(poses), _points(given), reflection=False)
    similarity = torch.from_numpy(matrix).to(poses)
    scale = torch.linalg.det(similarity[:3, :3]) ** (1.0 / 3.0)
    result = similarity @ poses
    result[:, :3, :3] /= scale
    return result


def _points(poses: Float[Tensor, "views 4 4"]) -> Float[np.ndarray, "points 3"]:
    places = poses[:, None, :3, 3]
    points = torch.cat([places, places + poses[:, :3, :3].transpose(1, 2)], 1).flatten(0, 1)
    return points.double().cpu().numpy()
