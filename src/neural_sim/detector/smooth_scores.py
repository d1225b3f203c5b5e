"""Smooth scores, which the psi loop differentiates instead of the validation loss.

Average precision: detections come from the forward pass, after non-maximum suppression. Their anchors are fixed; their
scores and boxes are differentiated. Two step functions of COCO's definition become sigmoids: whether a detection is a
true positive (a sigmoid of its overlap), and whether it ranks below another (a sigmoid of the difference of logits;
Brown et al. 2020, Smooth-AP, Eq. 6). For top-1 accuracy, the step function "the right class is best" becomes that
class's probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.detector.classifier import class_of
from neural_sim.detector.protocol import Detector, Outputs
from neural_sim.ranges import NonNegative, Positive, PositiveInt, validated
from neural_sim.types import LabelledImages

THRESHOLDS = tuple(0.5 + 0.05 * step for step in range(10))
"""COCO's thresholds of intersection over union, over which AP is averaged."""


@dataclass(frozen=True)
class Ranked:
    """One class's detections in all images, with the nearest box of each; ordered by image, then falling score.

    ``overlaps`` is each detection's intersection over union with the nearest box of the class in its image, 0 if there
    is none. ``image`` is its image; ``box`` is the index of the nearest box among all boxes, -1 for none.
    ``boxes`` counts the class's boxes.
    """

    logits: Float[Tensor, "m"]
    overlaps: Float[Tensor, "m"]
    image: Int[Tensor, "m"]
    box: Int[Tensor, "m"]
    boxes: int


@validated
@dataclass(frozen=True)
class SmoothAP:
    """Settings of the smooth AP.

    Args:
        temperature: width of the ranks' sigmoid, in logits; AP is the limit at 0.
        width: width of the true positives' sigmoid, in intersection over union; AP is the limit at 0.
        per_class: number of best detections of each class in an image that count.
        loss: weight of the training loss that is added, because the AP of a class without true positives has no
            gradient, but the loss has one.
    """

    temperature: Positive = 0.2
    width: Positive = 0.1
    per_class: PositiveInt = 5
    loss: NonNegative = 0.1

    def __call__(
        self, detector: Detector, outputs: Outputs, images: LabelledImages
    ) -> Float[Tensor, "classes images"]:
        """Compute each image's contribution to every class's AP.

        A row sums to the class's AP; it is nan for a class without boxes.
        """
        rows = []
        for detections in ranked(detector, outputs, images, self.per_class):
            row = detections.logits.new_zeros(len(images))
            rows.append(
                row.index_add(0, detections.image, self.of_class(detections))
                if detections.boxes
                else row + torch.nan
            )
        return torch.stack(rows)

    def of_class(self, detections: Ranked) -> Float[Tensor, "m"]:
        """Compute each detection's contribution to one class's AP, the mean over ``THRESHOLDS``.

        Raises:
            ValueError: the class has no boxes, so its AP is undefined.
        """
        if detections.boxes == 0:
            raise ValueError("smooth_ap: want at least one box of the class")
        true = self.true_positives(detections)
        candidates = (detections.box >= 0).nonzero().flatten()  # only these can be true positives
        above = torch.sigmoid((detections.logits - detections.logits[candidates, None]) / self.temperature)
        # The sigmoid counts a detection as one half in its own rank, where it must count as one.
        above = above + 0.5 * (candidates[:, None] == torch.arange(len(detections.box), device=above.device))
        precision = (above @ true) / above.sum(1, keepdim=True)
        added = (true[candidates] * precision).mean(1) / detections.boxes
        return torch.zeros_like(detections.logits).index_add(0, candidates, added)

    def true_positives(self, detections: Ranked) -> Float[Tensor, "m thresholds"]:
        """Compute the degree in [0, 1] to which each detection is a true positive, at each threshold.

        It is the degree given by the overlap, times the degree to which no better-ranked detection is a true positive
        of the same box. The degrees of a box sum to at most 1.
        """
        levels = detections.overlaps.new_tensor(THRESHOLDS)
        matched = torch.sigmoid((detections.overlaps[:, None] - levels) / self.width)
        matched = torch.where((detections.box >= 0)[:, None], matched, 0.0)
        unclaimed = torch.ones_like(matched)
        for back in range(1, self.per_class):
            # The detection ``back`` places earlier, if it has the same box (in the same image).
            before, box = matched.roll(back, 0), detections.box
            same = (box == box.roll(back)) & (box >= 0)
            same = same & (torch.arange(len(same), device=same.device) >= back)
            unclaimed = unclaimed * torch.where(same[:, None], 1.0 - before, 1.0)
        return matched * unclaimed


def ranked(detector: Detector, outputs: Outputs, images: LabelledImages, per_class: int) -> list[Ranked]:
    """Rank each class's detections, at most ``per_class`` in an image; differentiable in the outputs."""
    best = detector.best(outputs, per_class)
    labels, boxes = images.labels.to(best.image.device), images.boxes.to(best.boxes)
    classes = []
    for number in range(outputs[0].shape[-1]):
        of_class, present = best.label == number, labels == number
        image = best.image[of_class]
        overlaps, which = nearest_box(best.boxes[of_class], boxes[image], present[image])
        box = torch.where(which >= 0, image * labels.shape[1] + which, -1)
        classes.append(Ranked(best.logits[of_class], overlaps, image, box, int(present.sum())))
    return classes


def nearest_box(
    boxes: Float[Tensor, "m 4"], truth: Float[Tensor, "m boxes 4"], present: Bool[Tensor, "m boxes"]
) -> tuple[Float[Tensor, "m"], Int[Tensor, "m"]]:
    """Find each detection's largest intersection over union with a ``present`` box, and that box; else 0 and -1."""
    if truth.shape[1] == 0:
        return boxes.new_zeros(len(boxes)), torch.full_like(boxes[:, 0], -1, dtype=torch.long)
    # Below every overlap, so that a detection that touches no box is not matched to a row without one.
    overlaps = torch.where(present, overlap(boxes[:, None], truth), -1.0)
    best, which = overlaps.max(1)
    return best.clamp_min(0.0), torch.where(present.any(1), which, -1)


def overlap(a: Float[Tensor, "*#n 4"], b: Float[Tensor, "*#n 4"]) -> Float[Tensor, "..."]:
    """Compute the intersection over union of boxes (x0, y0, x1, y1), pair by pair; differentiable in both."""
    sides = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp_min(0.0)
    shared = sides.prod(-1)
    areas = [(box[..., 2:] - box[..., :2]).clamp_min(0.0).prod(-1) for box in (a, b)]
    return shared / (areas[0] + areas[1] - shared).clamp_min(torch.finfo(shared.dtype).tiny)


@validated
@dataclass(frozen=True)
class SmoothAccuracy:
    """Settings of the smooth accuracy: the mean softmax probability of the right class.

    Args:
        temperature: temperature of the softmax, in logits; accuracy is the limit at 0.
        loss: weight of the training loss that is added, because that probability has hardly any gradient for an image
            whose class is far from the best, but the loss has one.
    """

    temperature: Positive = 0.5
    loss: NonNegative = 0.1

    def __call__(
        self, detector: Detector, outputs: Outputs, images: LabelledImages
    ) -> Float[Tensor, "classes images"]:
        """Compute each image's contribution to its class's accuracy.

        A row sums to the class's accuracy; it is nan for a class without images.
        """
        logits = outputs[0][:, 0]
        labels = class_of(images.labels).to(logits.device)
        probabilities = (logits / self.temperature).softmax(-1)
        right = probabilities.gather(1, labels.clamp(min=0)[:, None])[:, 0]
        own = labels == torch.arange(detector.num_classes, device=labels.device)[:, None]
        counts = own.sum(1, keepdim=True)
        return torch.where(counts > 0, own * right / counts.clamp(min=1), torch.nan)
