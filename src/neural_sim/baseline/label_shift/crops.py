"""Crops around labelled boxes, numbers that describe the boxes, and augmentations for variation that renders lack."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, grid_sample
from torchvision.ops import box_iou, roi_align

from neural_sim.ranges import Fraction, NonNegative, validated
from neural_sim.target.split import ALIKE, CELLS, correlation, thumbnail
from neural_sim.types import LabelledImages

SIDE = 32
"""Side of the network's input, in pixels."""
MARGIN = 1.5
"""Side of a stored crop, in multiples of the box's longer side. It contains nearly all of a rotated and shifted view;
beyond it, the crop's border is repeated."""
_STORED = 44
_COMPARED = 1024  # boxes that are compared with all others at once, which bounds the memory
_COVERED = 0.75  # if boxes cover more of an image than this, too little is left around them to compare
SHOWN = 1.1
"""Side of the network's view, in multiples of the box's longer side."""
RENDERED_ROLL_DEG, ANY_ROLL_DEG = 10.0, 180.0
"""Largest rotation of crops in the image plane, in degrees: for rendered targets, and for photographs."""
BOX_NUMBERS = 5
"""How many numbers describe a box."""
SIZE = (0, 1, 4)
"""The indices of the numbers that describe its size: width, height and whether the border may cut it off."""


@dataclass(frozen=True)
class Crops:
    """Square crops around boxes.

    Attributes:
        pixels: pixels in [0, 1]; outside the image, they have its mean colour.
        boxes: logarithms of width and height as fractions of the image's, the centre from -1 to 1, and 1 if the box
            touches the border, else 0.
        labels: class of each crop.
        rows: row of each crop's image in the set.
    """

    pixels: Float[Tensor, "n 3 side side"]
    boxes: Float[Tensor, "n numbers"]
    labels: Int[Tensor, "n"]
    rows: Int[Tensor, "n"]

    def __len__(self) -> int:
        return len(self.labels)

    def select(self, index: Tensor) -> Crops:
        """Select some crops."""
        return Crops(*(getattr(self, part.name)[index] for part in fields(Crops)))

    @staticmethod
    def concatenate(parts: Sequence[Crops]) -> Crops:
        """Join several sets."""
        return Crops(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Crops)))


def crops_of(images: LabelledImages, whole: bool) -> Crops:
    """Cut out all labelled boxes, image by image; with ``whole``, the whole image in place of each box."""
    rows, columns = images.present.nonzero().unbind(1)
    height, width = images.images.shape[-2:]
    edges = images.boxes.new_tensor([width, height, width, height])
    boxes = images.boxes[rows, columns]
    if whole:
        boxes = (edges * edges.new_tensor([0.0, 0.0, 1.0, 1.0])).expand(len(rows), 4)
    size = (boxes[:, 2:] - boxes[:, :2]).clamp_min(1.0)
    centre = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    half = 0.5 * MARGIN * size.amax(1, keepdim=True)
    regions = torch.cat([rows[:, None].to(boxes), centre - half, centre + half], 1)
    # roi_align pads with 0: subtracting the mean colour before it, and adding it again, pads with the mean colour.
    mean = images.images.mean((2, 3), keepdim=True)
    ratio = max(1, round(float(2.0 * half.median()) / _STORED)) if len(rows) else 1
    pixels = (
        roi_align(images.images - mean, regions, _STORED, sampling_ratio=ratio, aligned=True) + mean[rows]
    )
    touches = ((boxes < 1.0) | (boxes > edges - 1.0))[:, :2].any(1) | (boxes[:, 2:] > edges[2:] - 1.0).any(1)
    numbers = torch.cat(
        [(size / edges[2:]).log(), 2.0 * centre / edges[2:] - 1.0, touches[:, None].to(boxes)], 1
    )
    return Crops(pixels, numbers, images.labels[rows, columns], rows)


def views_of(images: LabelledImages, whole: bool) -> Int[Tensor, "boxes"]:
    """Return the number of the view that each box shows; near-duplicates, such as frames of one video, share a view.

    Two boxes show one view if they have the same label and overlap by half, and if their images look alike
    (``target.split``), even outside all boxes: independent photographs, too, may show an object in the same pose. With
    ``whole``, only the label and the image count. All boxes that a chain of such pairs connects show one view. The
    order is that of ``crops_of``.
    """
    looks = torch.stack([_looks(images, row, whole) for row in range(len(images))], 1)
    rows, columns = images.present.nonzero().unbind(1)
    labels, boxes = images.labels[rows, columns], images.boxes[rows, columns]
    views = torch.arange(len(rows))
    for label in labels.unique():
        mine = (labels == label).nonzero()[:, 0]
        pairs = []
        for part in torch.arange(len(mine)).split(_COMPARED):
            own = mine[part]
            same = torch.ones(len(own), len(mine), dtype=torch.bool)
            for look in looks:
                same &= correlation(look[rows[own]], look[rows[mine]]) >= ALIKE
            if not whole:
                same &= box_iou(boxes[own], boxes[mine]) >= 0.5
            pairs.append(same.nonzero() + part[0] * torch.tensor([1, 0]))
        one, other = torch.cat(pairs).T.numpy()
        graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(len(mine), len(mine)))
        _, component = connected_components(graph, directed=False)
        _, first, inverse = np.unique(component, return_index=True, return_inverse=True)
        views[mine] = mine[torch.from_numpy(first[inverse])]
    return views


def _looks(images: LabelledImages, row: int, whole: bool) -> Float[Tensor, "looks 24 24"]:
    """Return thumbnails of an image and, unless ``whole``, of what is outside its boxes.

    Plain borders are cut off first, because their edges would make all letterboxed photographs look alike. Boxes that
    cover most of the image are not blanked out.
    """
    image, inside = images.images[row], torch.zeros_like(images.images[row, :1])
    for box in images.boxes[row, images.present[row]]:
        low, high = box[:2].floor().long().clamp_min(0), box[2:].ceil().long()
        inside[:, low[1] : high[1], low[0] : high[0]] = 1.0
    for axis in (1, 2):
        varied = (image.amax(axis) - image.amin(axis)).amax(0) > 1e-3
        kept = varied.nonzero()[:, 0]
        if len(kept):
            start, length = int(kept[0]), int(kept[-1] - kept[0]) + 1
            image, inside = (each.narrow(3 - axis, start, length) for each in (image, inside))
    look = thumbnail(image)
    if whole:
        return look[None]
    covered = adaptive_avg_pool2d(inside, CELLS)[0] > 0.0
    if covered.float().mean() > _COVERED:
        return torch.stack([look, look])
    return torch.stack([look, look.masked_fill(covered, 0.0)])


@validated
@dataclass(frozen=True)
class Augmentation:
    """Random changes of crops, so that renders cover the variation of photographs.

    Args:
        roll_deg: largest rotation in the image plane, in either direction, in degrees. Objects are also compared with
            renders that are rotated by as much. None: 10 for rendered targets, 180 (any roll) for photographs.
        exposure: largest change of brightness, in either direction, in stops; contrast and colour change with it. Not
            used if psi has lights.
        blur: largest fraction of a crop's detail that is lost.
        noise: largest standard deviation of pixel noise.
        occlusion: fraction of the crops in which a rectangle is hidden.
        jitter: largest change of a crop's scale, and largest shift in multiples of the box's longer side. The numbers
            that describe the box change by up to 1.5 times as much.
    """

    roll_deg: Annotated[float, Ge(0), Le(180)] | None = None
    exposure: NonNegative = 1.0
    blur: Fraction = 0.8
    noise: Fraction = 0.04
    occlusion: Fraction = 0.3
    jitter: Annotated[float, Ge(0), Le(0.5)] = 0.08

    @property
    def largest_roll_deg(self) -> float:
        """``roll_deg``; if it is left open, that of rendered targets."""
        return RENDERED_ROLL_DEG if self.roll_deg is None else self.roll_deg

    def __call__(self, crops: Crops, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the network's view of the crops and the numbers of their boxes, both changed at random."""
        n, like = len(crops), crops.pixels

        def either(*shape: int) -> Tensor:
            return (2.0 * torch.rand((n, *shape), generator=generator) - 1.0).to(like)

        zoom, shift = self.jitter * either(), self.jitter * either(2)
        like = like + self.blur * either(1, 1, 1).abs() * (_softened(like) - like)
        seen = _sampled(like, math.radians(self.largest_roll_deg) * either(), zoom.exp(), shift)
        gain = (math.log(2.0) * self.exposure * (either(1, 1, 1) + 0.2 * either(3, 1, 1))).exp()
        mean = seen.mean((2, 3), keepdim=True)
        seen = (mean + (seen - mean) * (0.3 * self.exposure * either(1, 1, 1)).exp()) * gain
        seen = seen + self.noise * either(1, 1, 1).abs() * torch.randn(seen.shape, generator=generator).to(
            seen
        )
        seen = self._hidden(seen, generator).clamp(0.0, 1.0)
        numbers = crops.boxes.clone()
        numbers[:, :2] += zoom[:, None] + 0.5 * self.jitter * either(2)
        numbers[:, 2:4] += self.jitter * either(2)
        return seen - 0.5, numbers

    def _hidden(self, seen: Tensor, generator: torch.Generator) -> Tensor:
        n, at = len(seen), torch.arange(SIDE) + 0.5
        u = torch.rand((5, n, 1), generator=generator)
        across = (at - SIDE * u[0]).abs() < SIDE * (0.08 + 0.17 * u[1])
        down = (at - SIDE * u[2]).abs() < SIDE * (0.08 + 0.17 * u[3])
        covers = (across[:, None, :] & down[:, :, None] & (u[4] < self.occlusion)[..., None])[:, None]
        # The rectangle shows part of another crop: a texture, not a plain colour.
        other = seen[torch.randperm(n, generator=generator)].flip(3)
        return torch.where(covers.to(seen.device), other, seen)


def plain(crops: Crops) -> tuple[Tensor, Tensor]:
    """Return the network's view of unchanged crops, and the numbers of their boxes."""
    zero = crops.pixels.new_zeros(len(crops))
    seen = _sampled(crops.pixels, zero, zero + 1.0, torch.stack([zero, zero], 1))
    return seen - 0.5, crops.boxes


def quarters(crops: Crops) -> Float[Tensor, "n 12"]:
    """Return the mean colours of the four quarters of the network's view."""
    return adaptive_avg_pool2d(plain(crops)[0], 2).flatten(1)


def _softened(pixels: Float[Tensor, "n 3 side side"]) -> Float[Tensor, "n 3 side side"]:
    """Blur with the weights 1, 2, 3, 2, 1 along both axes."""
    for axis in (2, 3):
        for _ in range(2):
            ahead, behind = (pixels.roll(step, axis) for step in (1, -1))
            pixels = (pixels + ahead + behind) / 3.0
    return pixels


def _sampled(pixels: Tensor, roll: Tensor, zoom: Tensor, shift: Tensor) -> Float[Tensor, "n 3 side side"]:
    """Sample the middle of stored crops, rotated, scaled, and shifted by multiples of the box's longer side."""
    if not len(pixels):
        return pixels.new_zeros(0, 3, SIDE, SIDE)
    scale = SHOWN / MARGIN * zoom
    cosine, sine = scale * roll.cos(), scale * roll.sin()
    moved = shift / MARGIN
    matrix = torch.stack([cosine, -sine, moved[:, 0], sine, cosine, moved[:, 1]], -1).view(-1, 2, 3)
    grid = affine_grid(matrix, [len(pixels), 3, SIDE, SIDE], align_corners=False)
    return grid_sample(pixels, grid, padding_mode="border", align_corners=False)
