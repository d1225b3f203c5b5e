"""RetinaNet (Lin et al. 2017): anchor boxes of several sizes at every location of every level."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.retinanet import RetinaNetHead
from torchvision.ops import clip_boxes_to_image
from typing_extensions import override

from neural_sim.detector.losses import IGNORED, Targets, assign_anchors, box_loss, focal_loss
from neural_sim.detector.network import fixed_anchors, group_norm
from neural_sim.detector.on_backbone import ImageSize, PyramidDetector
from neural_sim.detector.protocol import Outputs
from neural_sim.detector.settings import Activation, Anchors, Backbone, Detections, Head, Losses
from neural_sim.ranges import NonNegative, PositiveInt, validated


@validated
class RetinaNet(PyramidDetector):
    """A RetinaNet for images of one size.

    It holds the network's shape, the anchors and the loss, but no parameters.

    Args:
        anchors: the anchors, and how they are assigned to objects.
        losses: the loss of an anchor's prediction.

    See ``PyramidDetector`` for the other arguments, which it checks.
    """

    def __init__(
        self,
        num_classes: PositiveInt,
        image_size: ImageSize = 96,
        backbone: Backbone = Backbone(),
        head: Head = Head(),
        anchors: Anchors = Anchors(),
        losses: Losses = Losses(),
        detections: Detections = Detections(),
        activation: Activation = "silu",
        proximal: NonNegative = 0.0,
    ) -> None:
        norm = group_norm if head.normalisation == "group" else None
        per_location = len(anchors.sizes[0]) * len(anchors.ratios)
        network = RetinaNetHead(head.channels, per_location, num_classes, norm_layer=norm)
        for branch in (network.classification_head, network.regression_head):
            branch.conv = branch.conv[: head.convs]
        super().__init__(
            num_classes, image_size, backbone, head, anchors.strides, "detector.anchors", network, detections,
            activation, proximal,
        )  # fmt: skip
        self._losses, self._overlaps = losses, (anchors.foreground_iou, anchors.background_iou)
        self.anchors, self.anchors_per_level = fixed_anchors(anchors, self.image_size)

    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """Assign a target to every anchor, see ``losses.assign_anchors``.

        Raises:
            ValueError: a label is not below ``num_classes``, or a box has no area.
        """
        self.check_labels(labels)
        return assign_anchors(self.anchors.to(boxes), boxes, labels, *self._overlaps)

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Sum each image's focal and box losses over anchors, and divide by the number in the foreground, if any."""
        (logits, deltas), costs = outputs, self._losses
        labels = targets.labels
        classes = torch.arange(self.num_classes, device=labels.device)
        wanted = (labels[..., None] == classes).to(logits.dtype)
        foreground = (labels >= 0).to(logits.dtype)
        counted = (labels != IGNORED).to(logits.dtype)
        focal = focal_loss(logits, wanted, costs.focal_alpha, costs.focal_gamma).sum(-1) * counted
        residual = deltas - targets.deltas.to(deltas.dtype)
        regression = box_loss(residual, costs.box, costs.box_delta).sum(-1) * foreground
        return (focal + regression).sum(-1) / foreground.sum(-1).clamp(min=1)

    @override
    def decode(
        self, code: Float[Tensor, "*n 4"], anchor: Int[Tensor, "m"] | None = None
    ) -> Float[Tensor, "*n 4"]:
        anchors = self.anchors.to(code)
        chosen = anchors.expand(code.shape[0], -1, -1).reshape(-1, 4) if anchor is None else anchors[anchor]
        boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(code.reshape(-1, 4), chosen)
        return clip_boxes_to_image(boxes, self.image_size).reshape(code.shape)
