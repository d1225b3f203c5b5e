"""What the psi loop needs of a detector: pure functions of a parameter dictionary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.detector.targets import Targets

Parameters = dict[str, Tensor]
Outputs = tuple[Float[Tensor, "n anchors classes"], Float[Tensor, "n anchors 4"]]


@dataclass(frozen=True)
class Best:
    """The best detections of every class in every image, image by image and class by class, the best first.

    ``boxes`` are (x0, y0, x1, y1) in pixels. ``logits`` and ``boxes`` are differentiable in the outputs that they come
    from; which outputs these are is fixed.
    """

    image: Int[Tensor, "m"]
    label: Int[Tensor, "m"]
    logits: Float[Tensor, "m"]
    boxes: Float[Tensor, "m 4"]


class Detector(Protocol):
    """A detector for images of one size. It holds a shape and settings, never its parameters, which come in as an
    argument, so that losses can be differentiated any number of times, in forward and in reverse mode.

    Its parameters are those of a backbone, which the psi loop freezes, and of what stands on its features.
    ``proximal`` is lambda of ``lambda / 2 |theta - theta_0|^2`` in the psi loop's inner problem, theta_0 the warm
    start. A class is constructed with ``num_classes`` and ``image_size``, (height, width) in pixels, by name; other
    arguments come from its file in ``conf/detector``.
    """

    proximal: float

    def init(self, generator: torch.Generator) -> Parameters:
        """Fresh parameters in float32 on the CPU, all of them."""
        ...

    def split(self, params: Parameters) -> tuple[Parameters, Parameters]:
        """Parameters of the backbone, and of the rest."""
        ...

    def learnable(self, params: Parameters) -> list[str]:
        """Names of everything that a training outside the psi loop changes."""
        ...

    def features(self, backbone: Parameters, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """The predictor's inputs for images in [0, 1]: tensors with a row for each image."""
        ...

    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        """Class logits and encoded boxes of every anchor."""
        ...

    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """What every anchor should give; rows of label -1 are no boxes. Differentiable in the boxes."""
        ...

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """The loss of each image."""
        ...

    def per_image_loss(
        self, trainable: Parameters, features: Sequence[Tensor], targets: Targets
    ) -> Float[Tensor, "n"]:
        """:meth:`losses_of` the :meth:`outputs`."""
        ...

    def best(self, outputs: Outputs, per_class: int) -> Best:
        """At most ``per_class`` detections of each class in each image, after non-maximum suppression, however low."""
        ...

    def predict(
        self, params: Parameters, images: Float[Tensor, "n 3 h w"], batch_size: int = 64
    ) -> list[dict[str, Tensor]]:
        """Detections of each image, best first, on the CPU: boxes [d, 4] in pixels, scores [d], labels [d]."""
        ...
