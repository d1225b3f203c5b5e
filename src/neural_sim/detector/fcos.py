"""FCOS (Tian et al. 2019): each feature-map location is a point that predicts its distances to a box's sides."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F
from torchvision.models.detection.fcos import FCOSClassificationHead, FCOSRegressionHead
from torchvision.ops import clip_boxes_to_image
from typing_extensions import override

from neural_sim.detector.losses import Targets, assign_points, focal_loss
from neural_sim.detector.network import fixed_anchors, group_norm
from neural_sim.detector.on_backbone import ImageSize, PyramidDetector
from neural_sim.detector.protocol import Outputs
from neural_sim.detector.settings import (
    Activation,
    Anchors,
    Backbone,
    BetweenZeroAndOne,
    Detections,
    Head,
    Points,
)
from neural_sim.ranges import NonNegative, PositiveInt, validated


class FcosHead(nn.Module):
    """torchvision's head with two branches.

    The code holds the distances, in strides, to the left, upper, right and lower side of the box, and the centre-ness
    logit. Softplus keeps the distances positive. torchvision's ReLU, which ``activation=relu`` keeps, has no curvature,
    and no gradient at negative values.
    """

    def __init__(self, settings: Head, num_classes: int, activation: str) -> None:
        super().__init__()
        norm = group_norm if settings.normalisation == "group" else lambda _: nn.Identity()
        self.classification_head = FCOSClassificationHead(
            settings.channels, 1, num_classes, settings.convs, norm_layer=norm
        )
        self.regression_head = FCOSRegressionHead(settings.channels, 1, settings.convs, norm_layer=norm)
        if settings.normalisation == "group":
            # Normalisation cancels a shift shared by all channels of a group, so the gradient along that shift is mere
            # rounding error. AdamW would divide by that error, and the derivative through a training would magnify it.
            for branch in (self.classification_head, self.regression_head):
                for layer in branch.conv:
                    if isinstance(layer, nn.Conv2d):
                        layer.bias = None
        self.positive = F.relu if activation == "relu" else F.softplus

    @override
    def forward(self, levels: list[Tensor]) -> dict[str, Tensor]:
        codes, head = [], self.regression_head
        for level in levels:
            shared = head.conv(level)
            code = torch.cat([self.positive(head.bbox_reg(shared)), head.bbox_ctrness(shared)], 1)
            codes.append(code.flatten(2).transpose(1, 2))
        return {"cls_logits": self.classification_head(levels), "bbox_regression": torch.cat(codes, 1)}


@validated
class Fcos(PyramidDetector):
    """An FCOS for images of one size.

    It holds the network's shape, the points and the loss, but no parameters.

    Args:
        points: the points, and how they are assigned to objects.
        focal_alpha, focal_gamma: parameters of the focal loss (Lin et al. 2017, Eq. 5).

    See ``PyramidDetector`` for the other arguments, which it checks.
    """

    def __init__(
        self,
        num_classes: PositiveInt,
        image_size: ImageSize = 96,
        backbone: Backbone = Backbone(),
        head: Head = Head(),
        points: Points = Points(),
        focal_alpha: BetweenZeroAndOne = 0.25,
        focal_gamma: NonNegative = 2.0,
        detections: Detections = Detections(),
        activation: Activation = "silu",
        proximal: NonNegative = 0.0,
    ) -> None:
        super().__init__(
            num_classes, image_size, backbone, head, points.strides, "detector.points",
            FcosHead(head, num_classes, activation), detections, activation, proximal,
        )  # fmt: skip
        self._focal, self._radius = (focal_alpha, focal_gamma), points.radius
        # torchvision's points are the centres of anchors as large as a stride.
        squares = Anchors(points.strides, [[stride] for stride in points.strides], None)
        cells, self.anchors_per_level = fixed_anchors(squares, self.image_size)
        self.points, self.strides = 0.5 * (cells[:, :2] + cells[:, 2:]), cells[:, 2] - cells[:, 0]
        self.ranges = _of_points(points.ranges(min(self.image_size)), self.anchors_per_level)

    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """Assign a target to every point, see ``losses.assign_points``.

        Raises:
            ValueError: a label is not below ``num_classes``, or a box has no area.
        """
        self.check_labels(labels)
        points, strides, ranges = (part.to(boxes) for part in (self.points, self.strides, self.ranges))
        return assign_points(points, strides, ranges, boxes, labels, self._radius)

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Add up the focal, box and centre-ness losses of each image.

        The box loss uses the generalised intersection over union (Rezatofighi et al. 2019). Each loss is a sum over
        points, divided by the image's number of foreground points, if any.
        """
        (logits, code), labels = outputs, targets.labels
        wanted = (labels[..., None] == torch.arange(self.num_classes, device=labels.device)).to(logits.dtype)
        foreground = (labels >= 0).to(logits.dtype)
        focal = focal_loss(logits, wanted, *self._focal).sum(-1)
        distances = targets.deltas.to(code.dtype)
        apart = 1.0 - generalised_iou(code[..., :4], distances)
        centred = centreness(distances)
        # Cross-entropy of a logit, written with softplus, which has derivatives of every order in both modes.
        off_centre = F.softplus(code[..., 4]) - centred * code[..., 4]
        return (focal + (apart + off_centre) * foreground).sum(-1) / foreground.sum(-1).clamp(min=1)

    @override
    def decode(
        self, code: Float[Tensor, "*n 5"], anchor: Int[Tensor, "m"] | None = None
    ) -> Float[Tensor, "*n 4"]:
        points, strides = self.points.to(code), self.strides.to(code)
        if anchor is not None:
            points, strides = points[anchor], strides[anchor]
        reach = code[..., :4] * strides[:, None]
        boxes = torch.cat([points - reach[..., :2], points + reach[..., 2:]], -1)
        return clip_boxes_to_image(boxes.reshape(-1, 4), self.image_size).reshape(boxes.shape)

    def ranking(self, outputs: Outputs) -> Float[Tensor, "n anchors classes"]:
        """Return logits of torchvision's scores, the geometric means of class probability and centre-ness."""
        logits, code = outputs
        log = 0.5 * (F.logsigmoid(logits) + F.logsigmoid(code[..., 4:]))
        log = log.clamp_max(-torch.finfo(log.dtype).eps)  # a score of 1 has no logit
        return log - torch.log(-torch.expm1(log))


def generalised_iou(ours: Float[Tensor, "*n 4"], theirs: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Compute the generalised IoU of pairs of boxes that contain a common point.

    A box is given by the point's distances to its sides. The boxes ``theirs`` must have a positive area.
    """
    least, most = torch.minimum(ours, theirs), torch.maximum(ours, theirs)
    inside, hull, area, other = (_area(part) for part in (least, most, ours, theirs))
    union = area + other - inside
    return inside / union - (hull - union) / hull


def centreness(distances: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Measure how near a point is to its box's centre (Tian et al. 2019, Eq. 3), from its distances to the sides."""
    before, after = distances[..., :2], distances[..., 2:]
    return (torch.minimum(before, after) / torch.maximum(before, after)).prod(-1).sqrt()


def _area(distances: Tensor) -> Tensor:
    return (distances[..., :2] + distances[..., 2:]).prod(-1)


def _of_points(ranges: Sequence[tuple[float, float]], per_level: Sequence[int]) -> Float[Tensor, "points 2"]:
    return torch.cat([torch.tensor(r).expand(n, 2) for r, n in zip(ranges, per_level, strict=True)])
