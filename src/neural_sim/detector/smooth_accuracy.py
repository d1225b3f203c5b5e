"""A smooth top-1 accuracy, which the psi loop differentiates in the place of a classifier's validation loss."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.classifier import class_of
from neural_sim.detector.protocol import Detector, Outputs
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class SmoothAccuracy:
    """Settings of the smooth accuracy: the step of the right class being the best one becomes its softmax probability.

    Args:
        temperature: of the softmax, in logits; accuracy is the limit at 0.
        loss: weight of the training loss that is added. An image whose class is far from the best has hardly a
            gradient of its own; its loss has.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    temperature: float = 0.5
    loss: float = 0.1

    def __post_init__(self) -> None:
        if not self.temperature > 0.0:
            raise ValueError(f"smooth_accuracy.temperature must be above 0, got {self.temperature}")
        if not self.loss >= 0.0:
            raise ValueError(f"smooth_accuracy.loss must be at least 0, got {self.loss}")

    def __call__(
        self, detector: Detector, outputs: Outputs, images: LabelledImages
    ) -> Float[Tensor, "classes images"]:
        """Each image's contribution to the accuracy of its class, the sum of a row; nan for a class without images."""
        logits = outputs[0][:, 0]
        labels = class_of(images.labels).to(logits.device)
        probabilities = (logits / self.temperature).softmax(-1)
        right = probabilities.gather(1, labels.clamp(min=0)[:, None])[:, 0]
        own = labels == torch.arange(detector.num_classes, device=labels.device)[:, None]
        counts = own.sum(1, keepdim=True)
        return torch.where(counts > 0, own * right / counts.clamp(min=1), torch.nan)
