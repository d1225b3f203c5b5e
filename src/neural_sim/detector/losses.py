"""Targets of anchors and points, and the losses of their predictions.

The default losses are smooth, so their Hessians predict the effect of a finite step (that of ``l1`` does not).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F
from torchvision.models.detection._utils import encode_boxes
from torchvision.ops import box_iou

BACKGROUND = -1
IGNORED = -2


@dataclass(frozen=True)
class Targets:
    """The class and the box that each anchor should predict; an anchor-free detector's anchors are its points.

    ``labels`` is the class index of the anchor's box, ``BACKGROUND``, or ``IGNORED`` (overlap between the two
    thresholds). ``deltas`` is the box in the detector's code (for an anchor: centre shift in anchor sizes and log size
    ratio; for a point: distances to the sides in strides), or any finite value if there is no box. It carries gradients
    with respect to the boxes.
    """

    labels: Int[Tensor, "images anchors"]
    deltas: Float[Tensor, "images anchors 4"]

    def __len__(self) -> int:
        return self.labels.shape[0]

    def select(self, index: Tensor | slice) -> Targets:
        """Return the targets of some images."""
        return Targets(self.labels[index], self.deltas[index])


def assign_anchors(
    anchors: Float[Tensor, "anchors 4"],
    boxes: Float[Tensor, "images boxes 4"],
    labels: Int[Tensor, "images boxes"],
    foreground_iou: float,
    background_iou: float,
) -> Targets:
    """Match anchors to boxes like torchvision's ``Matcher`` with low-quality matches, but all images at once.

    Boxes are (x0, y0, x1, y1) in pixels; rows with label -1 are padding. An anchor takes the box it overlaps
    most if that overlap reaches ``foreground_iou``, or if the anchor is the best one for any box (not necessarily for
    that one); otherwise it is ignored if its overlap is between the thresholds.

    Raises:
        ValueError: a box that is not padding has no area.
    """
    present = _present(boxes, labels)
    images, count = labels.shape
    if count == 0:
        shape = (images, anchors.shape[0])
        return Targets(labels.new_full(shape, BACKGROUND), boxes.new_zeros((*shape, 4)))
    with torch.no_grad():
        overlap = box_iou(boxes.reshape(-1, 4), anchors).view(images, count, -1)
        overlap = torch.where(present[..., None], overlap, -1.0)
        best, match = overlap.max(dim=1)
        most = overlap.amax(dim=2, keepdim=True)
        # Without the second condition, a box that no anchor touches, or padding, would make every anchor foreground.
        rescued = ((overlap == most) & (most > 0)).any(dim=1)
        foreground = (best >= foreground_iou) | rescued
        ignored = (best >= background_iou) & ~foreground
    anchor_labels = torch.where(foreground, labels.gather(1, match), BACKGROUND)
    anchor_labels = torch.where(ignored, IGNORED, anchor_labels)
    matched = boxes.gather(1, match[..., None].expand(-1, -1, 4))
    # Background anchors are matched to themselves: padding boxes have no log size, and zero times NaN is NaN.
    matched = torch.where(foreground[..., None], matched, anchors)
    tiled = anchors.expand(images, -1, 4).reshape(-1, 4)
    deltas = encode_boxes(matched.reshape(-1, 4), tiled, boxes.new_ones(4)).view(images, -1, 4)
    return Targets(anchor_labels, deltas)


def assign_points(
    points: Float[Tensor, "points 2"],
    strides: Float[Tensor, "points"],
    ranges: Float[Tensor, "points 2"],
    boxes: Float[Tensor, "images boxes 4"],
    labels: Int[Tensor, "images boxes"],
    radius: float,
) -> Targets:
    """Match points to boxes like torchvision's FCOS, except at the end of a range.

    A point takes the smallest box around it whose centre is less than ``radius`` strides away along both axes, and
    whose farthest side is at a distance in the point's range, more than its low and at most its high end, in pixels.
    (torchvision excludes both ends, so a distance equal to a limit belongs to neither level. That happens to boxes of
    rendered masks, whose corners are whole pixels.)

    Boxes are (x0, y0, x1, y1) in pixels; rows with label -1 are padding.

    Raises:
        ValueError: a box that is not padding has no area.
    """
    present = _present(boxes, labels)
    images, count = labels.shape
    if count == 0:
        shape = (images, len(points))
        return Targets(labels.new_full(shape, BACKGROUND), boxes.new_ones((*shape, 4)))
    with torch.no_grad():
        corners = boxes[:, :, None]
        distances = torch.cat([points - corners[..., :2], corners[..., 2:] - points], -1)
        centres = 0.5 * (corners[..., :2] + corners[..., 2:])
        near = (points - centres).abs().amax(-1) < radius * strides
        farthest = distances.amax(-1)
        found = near & (distances.amin(-1) > 0) & (farthest > ranges[:, 0]) & (farthest <= ranges[:, 1])
        areas = (corners[..., 2:] - corners[..., :2]).prod(-1)
        smallest, match = torch.where(found & present[..., None], areas, torch.inf).min(1)
        foreground = smallest < torch.inf
    matched = boxes.gather(1, match[..., None].expand(-1, -1, 4))
    reach = torch.cat([points - matched[..., :2], matched[..., 2:] - points], -1) / strides[:, None]
    return Targets(
        torch.where(foreground, labels.gather(1, match), BACKGROUND),
        torch.where(foreground[..., None], reach, 1.0),
    )


def _present(boxes: Tensor, labels: Tensor) -> Tensor:
    """Find the rows that are not padding.

    Raises:
        ValueError: such a row has no area.
    """
    present = labels >= 0
    empty = present & (boxes[..., 2:] - boxes[..., :2] <= 0).any(-1)
    if bool(empty.any()):
        raise ValueError(f"assign: want boxes with x0 < x1 and y0 < y1, got {boxes[empty][0].tolist()}")
    return present


def focal_loss(
    logits: Float[Tensor, "*shape"], targets: Float[Tensor, "*shape"], alpha: float, gamma: float
) -> Float[Tensor, "*shape"]:
    """Compute the sigmoid focal loss of each element (Lin et al. 2017, Eq. 5); ``targets`` are 0 or 1.

    Softplus, unlike binary_cross_entropy_with_logits, has derivatives of every order in forward and reverse mode, and
    is stable for large logits as well.
    """
    sign = 2 * targets - 1
    cross_entropy = F.softplus(-sign * logits)
    if float(gamma).is_integer():
        damped = torch.sigmoid(-sign * logits) ** gamma
    else:  # where the sigmoid rounds to 0, a fractional power of it has infinite derivatives
        damped = torch.exp(-gamma * F.softplus(sign * logits))
    alpha_t = alpha * targets + (1 - alpha) * (1 - targets)
    return alpha_t * damped * cross_entropy


def box_loss(residual: Float[Tensor, "*shape"], kind: str, delta: float) -> Float[Tensor, "*shape"]:
    """Compute the loss of each element's error in an encoded box coordinate.

    ``pseudo_huber`` is delta (sqrt(1 + (r / delta)^2) - 1), smooth everywhere: quadratic within ``delta``, and with
    slope 1, as ``l1``, for large errors. ``l1`` is torchvision's default and has no curvature.
    """
    if kind == "l1":
        return residual.abs()
    square = (residual / delta) ** 2
    # sqrt(1 + square) - 1, without the subtraction, which would cancel every digit of a small residual.
    return delta * square / (torch.sqrt(1 + square) + 1)


def proximal_loss(
    params: Mapping[str, Tensor], anchor: Mapping[str, Tensor], proximal: float
) -> Float[Tensor, ""]:
    """Compute ``proximal / 2 |params - anchor|^2`` over the names in ``params``; the anchor is a constant."""
    squares = [(value - anchor[name].detach()).square().sum() for name, value in params.items()]
    return 0.5 * proximal * torch.stack(squares).sum()
