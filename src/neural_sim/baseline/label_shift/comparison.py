"""A guess of an object's pose without training: the bins whose renders a crop resembles most.

A network trained on renders misreads photographs, all the more if cameras have any roll. Templates compare only what
the object covers (as Hinterstoisser et al. 2012 do with gradients and normals), by three numbers: the correlation of
colours about their mean, which no exposure changes; the agreement of the slopes of brightness; and the ratio of the
box's sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, grid_sample, max_pool2d

from neural_sim.baseline.label_shift.crops import SHOWN, SIDE, Crops, plain
from neural_sim.synthesis.pool import PooledSubject

STEP_DEG = 15.0
"""Largest step between the angles by which templates are turned in the image plane."""
SLOPES, ASPECT = 2.0, 1.0
"""Weights of the slopes' agreement and of the difference between logarithms of the sides' ratios; colours have 1."""
SHARPNESS = 20.0
"""Factor of the scores in the soft maximum over templates."""
_FLAT = 0.02  # slopes of brightness, a pixel, that count half
_OPAQUE = 0.5


@dataclass(frozen=True)
class Templates:
    """Renders of an object without background, as the network would see their boxes, turned in the image plane.

    Attributes:
        colours: colours minus their mean over the object, weighted by opacity and divided by their norm.
        opacity: opacity; 0 where it is below one half.
        slopes: directions of the slopes of brightness inside the object; the lengths of all slopes sum to 1.
        aspect: logarithm of the ratio of the box's width to its height, both as fractions of the image's.
        poses: pose of each template, an index.
    """

    colours: Float[Tensor, "n 3 pixels"]
    opacity: Float[Tensor, "n pixels"]
    slopes: Float[Tensor, "n 2 pixels"]
    aspect: Float[Tensor, "n"]
    poses: Int[Tensor, "n"]

    @staticmethod
    def of(subject: PooledSubject, poses: Int[Tensor, "cells"], roll_deg: float) -> Templates | None:
        """Cut out all renders of an object, turned by up to ``roll_deg`` in either direction.

        Args:
            subject: the object's renders.
            poses: the pose of each of their cells.
            roll_deg: largest turn in the image plane, in degrees.

        Returns:
            The templates; None if no render shows the object.
        """
        rolls, parts = rolls_of(roll_deg), []
        for row, each in enumerate(subject.maps.to("cpu").flatten(0, 1)):
            if int((each[..., 3] > 255 * _OPAQUE).sum()) > 1:
                pose = poses[row // subject.per_cell].expand(len(rolls))
                parts.append(_templates(*_turned(each, rolls), pose))
        if not parts:
            return None
        return Templates(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Templates)))

    def __call__(self, crops: Crops, count: int) -> Float[Tensor, "crops count"]:
        """Return the score of each of ``count`` poses: a soft maximum of its templates' scores.

        A pose without templates has the lowest score of the others.
        """
        seen = plain(crops)[0]
        found = torch.full((len(crops), count), math.inf, dtype=torch.float64)
        for pose in self.poses.unique().tolist():
            own = (self.poses == pose).nonzero()[:, 0]
            scores = SHARPNESS * self._scored(seen, crops.boxes, own).double()
            found[:, pose] = (scores.logsumexp(1) - math.log(len(own))) / SHARPNESS
        return found.where(found.isfinite(), found.amin(1, keepdim=True))

    def _scored(
        self,
        seen: Float[Tensor, "crops 3 side side"],
        boxes: Float[Tensor, "crops numbers"],
        rows: Int[Tensor, "n"],
    ) -> Float[Tensor, "crops n"]:
        opacity, pixels = self.opacity[rows], seen.flatten(2)
        total = opacity.sum(1).clamp_min(1e-6)
        sums = torch.einsum("ncp,mp->nmc", pixels, opacity)
        squares = pixels.square().sum(1) @ opacity.T
        norm = (squares - sums.square().sum(2) / total).clamp_min(1e-6).sqrt()
        colours = torch.einsum("ncp,mcp->nm", pixels, self.colours[rows]) / norm
        slopes = torch.einsum("ncp,mcp->nm", _directions(seen)[0].flatten(2), self.slopes[rows])
        apart = ((boxes[:, 0] - boxes[:, 1])[:, None] - self.aspect[rows]).abs()
        whole = boxes[:, 4:] == 0.0  # the sides of a box that the image's border cuts off say nothing
        return colours + SLOPES * slopes - ASPECT * torch.where(whole, apart, 0.0)


def rolls_of(roll_deg: float) -> Float[Tensor, "rolls"]:
    """Return angles from ``-roll_deg`` to ``roll_deg``, at most ``STEP_DEG`` apart, in radians; 180 is there once."""
    count = 2 * math.ceil(roll_deg / STEP_DEG) + 1
    angles = torch.linspace(-roll_deg, roll_deg, count) if count > 1 else torch.zeros(1)
    return (angles[:-1] if roll_deg >= 180.0 else angles).deg2rad()


def _turned(
    render: UInt8[Tensor, "height width 4"], rolls: Float[Tensor, "rolls"]
) -> tuple[Float[Tensor, "rolls 4 side side"], Float[Tensor, "rolls"]]:
    """Turn a render, and cut out its box as ``crops.plain`` does; return it with the box's ``aspect``."""
    height, width = render.shape[:2]
    pixels = render.movedim(-1, 0)[None].float() / 255.0
    points = (pixels[0, 3] > _OPAQUE).nonzero().flip(1) + 0.5
    cosine, sine = rolls.cos(), rolls.sin()
    across = points[:, :1] * cosine + points[:, 1:] * sine
    down = points[:, 1:] * cosine - points[:, :1] * sine
    low, high = (torch.stack([f(across, 0).values, f(down, 0).values]) for f in (torch.min, torch.max))
    sides, middle = high - low + 1.0, 0.5 * (low + high)
    half = 0.5 * SHOWN * sides.amax(0)
    x, y = cosine * middle[0] - sine * middle[1], sine * middle[0] + cosine * middle[1]
    rows = torch.stack([cosine * half, -sine * half, x, sine * half, cosine * half, y], -1).view(-1, 2, 3)
    matrix = rows * (2.0 / torch.tensor([width, height]))[:, None] - torch.tensor([0.0, 0.0, 1.0])
    ratio = max(1, round(float(2.0 * half.median()) / SIDE))
    grid = affine_grid(matrix, [len(rolls), 4, ratio * SIDE, ratio * SIDE], align_corners=False)
    found = grid_sample(pixels.expand(len(rolls), -1, -1, -1), grid, align_corners=False)
    return avg_pool2d(found, ratio), (sides[0] / width).log() - (sides[1] / height).log()


def _templates(
    pixels: Float[Tensor, "n 4 side side"], aspect: Float[Tensor, "n"], poses: Int[Tensor, "n"]
) -> Templates:
    alpha = pixels[:, 3:]
    opacity = torch.where(alpha > _OPAQUE, alpha, 0.0)
    straight = pixels[:, :3] / alpha.clamp_min(1e-3)
    total = opacity.sum((2, 3), keepdim=True).clamp_min(1e-6)
    apart = straight - (opacity * straight).sum((2, 3), keepdim=True) / total
    norm = (opacity * apart.square()).sum((1, 2, 3), keepdim=True).clamp_min(1e-6).sqrt()
    directions, length = _directions(straight)
    # Slopes at the edge of the object are the background's as well.
    inside = 1.0 - max_pool2d(1.0 - opacity, 3, 1, 1)
    weight = inside * length / (length + 2.0 * _FLAT)
    slopes = weight * directions / weight.sum((2, 3), keepdim=True).clamp_min(1e-6)
    return Templates(
        (opacity * apart / norm).flatten(2), opacity.flatten(1), slopes.flatten(2), aspect, poses
    )


def _directions(
    pixels: Float[Tensor, "n 3 side side"],
) -> tuple[Float[Tensor, "n 2 side side"], Float[Tensor, "n 1 side side"]]:
    """Return directions of the slopes of brightness, shorter than 1 where it hardly varies, and the slopes' lengths."""
    grey = pixels.mean(1, keepdim=True)
    slopes = torch.zeros_like(grey).repeat(1, 2, 1, 1)
    slopes[:, :1, :, 1:-1] = grey[..., 2:] - grey[..., :-2]
    slopes[:, 1:, 1:-1] = grey[..., 2:, :] - grey[..., :-2, :]
    length = slopes.norm(dim=1, keepdim=True)
    return slopes / (length + _FLAT), length
