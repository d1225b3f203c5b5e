"""Which anchor should find which box: done once per image, for all images at a time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision.models.detection._utils import encode_boxes
from torchvision.ops import box_iou

BACKGROUND = -1
IGNORED = -2


@dataclass(frozen=True)
class Targets:
    """What each anchor of each image should predict.

    ``labels`` is the class index of the anchor's box, ``BACKGROUND`` or ``IGNORED`` (overlap between the two
    thresholds). ``deltas`` is the box in the anchor's code (centre shift in anchor sizes, log size ratio), zero
    where there is none; it carries gradients with respect to the boxes.
    """

    labels: Int[Tensor, "images anchors"]
    deltas: Float[Tensor, "images anchors 4"]

    def __len__(self) -> int:
        return self.labels.shape[0]

    def select(self, index: Tensor | slice) -> Targets:
        return Targets(self.labels[index], self.deltas[index])


def assign_anchors(
    anchors: Float[Tensor, "anchors 4"],
    boxes: Float[Tensor, "images boxes 4"],
    labels: Int[Tensor, "images boxes"],
    foreground_iou: float,
    background_iou: float,
) -> Targets:
    """Match anchors to boxes as torchvision's ``Matcher`` with low-quality matches does, without its loop.

    Boxes are (x0, y0, x1, y1) in pixels; rows with label -1 are padding. An anchor takes the box it overlaps
    most when that overlap reaches ``foreground_iou``, or when no anchor overlaps that box more; it is ignored
    between the thresholds.

    Raises:
        ValueError: where a box that is no padding has no area.
    """
    present = labels >= 0
    sides = boxes[..., 2:] - boxes[..., :2]
    if bool((present & (sides <= 0).any(-1)).any()):
        worst = boxes[present & (sides <= 0).any(-1)][0].tolist()
        raise ValueError(f"assign: boxes want x0 < x1 and y0 < y1, got {worst}")
    images, count = labels.shape
    if count == 0:
        shape = (images, anchors.shape[0])
        return Targets(labels.new_full(shape, BACKGROUND), boxes.new_zeros((*shape, 4)))
    with torch.no_grad():
        overlap = box_iou(boxes.reshape(-1, 4), anchors).view(images, count, -1)
        overlap = torch.where(present[..., None], overlap, -1.0)
        best, match = overlap.max(dim=1)
        most = overlap.amax(dim=2, keepdim=True)
        # A box that no anchor touches would otherwise be claimed by every anchor at overlap 0.
        rescued = ((overlap == most) & (most > 0)).any(dim=1)
        foreground = (best >= foreground_iou) | rescued
        ignored = (best >= background_iou) & ~foreground
    anchor_labels = torch.where(foreground, labels.gather(1, match), BACKGROUND)
    anchor_labels = torch.where(ignored, IGNORED, anchor_labels)
    matched = boxes.gather(1, match[..., None].expand(-1, -1, 4))
    # Background anchors are given themselves: padding rows have no logarithm, and zero times NaN is NaN.
    matched = torch.where(foreground[..., None], matched, anchors)
    tiled = anchors.expand(images, -1, 4).reshape(-1, 4)
    deltas = encode_boxes(matched.reshape(-1, 4), tiled, boxes.new_ones(4)).view(images, -1, 4)
    return Targets(anchor_labels, deltas)
