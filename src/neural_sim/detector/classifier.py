"""A classifier: a backbone, global average pooling, one linear layer.

It is a detector with one anchor, the whole image, whose box is not learned: its loss is the cross-entropy of the
image's class, and its one detection is the best class, with its softmax probability as the score.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Annotated, ClassVar

import torch
from annotated_types import Ge
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.func import functional_call

from neural_sim.detector.losses import IGNORED, Targets
from neural_sim.detector.on_backbone import BackboneDetector, ImageSize
from neural_sim.detector.protocol import Outputs, Parameters, Score
from neural_sim.detector.settings import ARCHITECTURES, Activation, Backbone, Detections
from neural_sim.ranges import NonNegative, validated


@validated
class Classifier(BackboneDetector):
    """A classifier for images of a fixed size that show one object each.

    The loss of an image without an object (label -1) is zero.

    See ``BackboneDetector`` for the arguments, which it checks.
    """

    score: ClassVar[Score] = "accuracy"
    detections = Detections(score_threshold=0.0, limit=1, candidates=1)

    def __init__(
        self,
        num_classes: Annotated[int, Ge(2)],
        image_size: ImageSize = 96,
        backbone: Backbone = Backbone(),
        activation: Activation = "silu",
        proximal: NonNegative = 0.0,
    ) -> None:
        last = ARCHITECTURES[backbone.architecture][-1]
        super().__init__(num_classes, image_size, backbone, (last,), activation, proximal)
        self._predictor = nn.Sequential(OrderedDict(head=nn.Linear(self._widths[0], num_classes)))

    def features(self, backbone: Parameters, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """Average the backbone's last map over the image, [n, c].

        In the psi loop, which trains the last stages, return the map before these stages.

        Raises:
            ValueError: the images do not have the classifier's size.
        """
        (maps,) = super().features(backbone, images)
        return (maps.mean((2, 3)) if self._last is None else maps,)

    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        """Return logits [n, 1, classes], and zeros [n, 1, 4] in place of a box code."""
        predictor, (values,) = self.completed(trainable, features)
        pooled = values if self._last is None else values.mean((2, 3))
        logits = functional_call(self._predictor, predictor, (pooled,), strict=True)[:, None]
        return logits, logits.new_zeros((*logits.shape[:2], 4))

    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """Return the class of each image's boxes; ``IGNORED`` for an image without a box.

        Raises:
            ValueError: a label is not below ``num_classes``, or an image shows objects of two classes.
        """
        self.check_labels(labels)
        own = class_of(labels)
        classes = torch.where(own >= 0, own, IGNORED)[:, None]
        return Targets(classes, boxes.new_zeros((len(classes), 1, 4)))

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Compute the cross-entropy of each image's class; 0 for an image without one."""
        logits, labels = outputs[0][:, 0], targets.labels
        wanted = logits.gather(1, labels.clamp(min=0))[:, 0]
        return (logits.logsumexp(1) - wanted) * (labels[:, 0] >= 0)

    def ranking(self, outputs: Outputs) -> Float[Tensor, "n 1 classes"]:
        """Return the logits of softmax probabilities, log(p / (1 - p))."""
        logits = outputs[0]
        itself = torch.eye(logits.shape[-1], dtype=torch.bool, device=logits.device)
        others = torch.where(itself, -torch.inf, logits[..., None, :]).logsumexp(-1)
        return logits - others

    def decode(
        self, code: Float[Tensor, "*n 4"], anchor: Int[Tensor, "m"] | None = None
    ) -> Float[Tensor, "*n 4"]:
        """Return the whole image as the box."""
        height, width = self.image_size
        return torch.zeros_like(code) + code.new_tensor([0.0, 0.0, width, height])


def class_of(labels: Int[Tensor, "n boxes"]) -> Int[Tensor, "n"]:
    """Return the class of each image; -1 for an image without a box.

    Raises:
        ValueError: an image has boxes of two classes.
    """
    if labels.shape[1] == 0:
        return labels.new_full((len(labels),), -1)
    own = labels.amax(1)
    mixed = ((labels >= 0) & (labels != own[:, None])).any(1)
    if bool(mixed.any()):
        row = int(mixed.nonzero()[0])
        raise ValueError(
            f"classifier: want objects of one class in an image, got {sorted(set(labels[row].tolist()) - {-1})} in "
            f"image {row}; a detector (task=detection) takes several"
        )
    return own
