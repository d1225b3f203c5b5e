"""Detectors of a backbone, torchvision's feature pyramid on it, and a head that all levels have in common.

The modules here are only the network's shape. Their values always come in as an argument, so that training losses can
be differentiated any number of times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call

from neural_sim.detector.backbones import ACTIVATIONS, IMAGENET_MEAN, IMAGENET_STD, build_backbone
from neural_sim.detector.initialise import initialise
from neural_sim.detector.network import NormalisedBackbone, build_predictor
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.settings import ARCHITECTURES, SAVED, Backbone, Detections, Head, check


class PyramidDetector(Detector):
    """A backbone, a feature pyramid and a head; a subclass makes the head, and its targets and losses.

    ``normalisation`` is what the backbone does first to the channels (red, green, blue) of images in [0, 1].

    Args:
        num_classes: classes, from 0, without a background class.
        image_size: (height, width) in pixels, or one number for a square.
        backbone, head: their settings.
        strides: of the pyramid's levels; ``where`` is their key.
        network: the head's module, of :attr:`Head.channels` channels; it returns ``cls_logits`` [n, anchors, classes]
            and ``bbox_regression`` [n, anchors, code].
        activation: ``silu`` or ``relu`` (torchvision's own), of backbone, pyramid and head.
        detections, proximal: see :class:`Detector`.

    Raises:
        ValueError: any of these out of its range, or strides that the backbone does not have, with the key and value.
    """

    normalisation: ClassVar[dict[str, tuple[float, ...]]] = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}

    def __init__(
        self,
        num_classes: int,
        image_size: int | tuple[int, int],
        backbone: Backbone,
        head: Head,
        strides: Sequence[int],
        where: str,
        network: nn.Module,
        detections: Detections,
        activation: str,
        proximal: float,
    ) -> None:
        strides, available = tuple(strides), ARCHITECTURES[backbone.architecture]
        own = tuple(stride for stride in strides if stride in available)
        check(
            where,
            strides=(
                strides,
                len(own) > 0
                and own == tuple(sorted(set(own)))
                and strides[len(own) :] == _coarser(own, strides, available),
                f"an ascending choice of {available} for {backbone.architecture}, and from its last on "
                "coarser ones, each twice the one before",
            ),
        )
        self.num_classes = num_classes
        height, width = (image_size, image_size) if isinstance(image_size, int) else image_size
        self.image_size = (height, width)
        self.proximal, self.detections = proximal, detections
        self._settings, self._head = backbone, head
        body = build_backbone(backbone.architecture, own, activation, backbone.weights)
        self._backbone = NormalisedBackbone(body)
        widths = [body.channels[stride] for stride in own]
        self._predictor = build_predictor(widths, len(strides), network, head, activation)

    def init(self, generator: torch.Generator) -> Parameters:
        """Fresh parameters in float32 on the CPU; pretrained backbones keep their weights.

        The dictionary also holds a frozen batch normalisation's statistics, so that it is complete.

        Raises:
            ValueError: a detector of a model file, whose parameters are there.
        """
        if self._settings.weights == SAVED:
            raise ValueError(
                f"detector.backbone.weights: {SAVED!r} is for detectors that are read from a model file; want null, "
                "a file or a name of torchvision's"
            )
        backbone = self._backbone.state_dict()
        if self._settings.weights is None:
            backbone = initialise(self._backbone, generator)
        predictor = initialise(self._predictor, generator, self._head.prior)
        return {name: value.detach().clone() for name, value in {**backbone, **predictor}.items()}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of all parameters, by name."""
        state = {**self._backbone.state_dict(), **self._predictor.state_dict()}
        return {name: tuple(value.shape) for name, value in state.items()}

    def learnable(self, params: Parameters) -> list[str]:
        """Names of everything that a full training changes: all but frozen statistics or a frozen backbone."""
        learned = (self._predictor,) if self._settings.freeze else (self._backbone, self._predictor)
        names = {n for module in learned for n, _ in module.named_parameters()}
        return [name for name in params if name in names]

    def features(self, backbone: Parameters, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """Feature maps [n, c, h / stride, w / stride] of each level, worth caching while the backbone is frozen.

        Raises:
            ValueError: where the images are not of the detector's size.
        """
        if tuple(images.shape[-3:]) != (3, *self.image_size):
            raise ValueError(
                f"detector: images want shape [n, 3, {self.image_size}], got {tuple(images.shape)}"
            )
        dtype = next(value.dtype for value in backbone.values() if value.is_floating_point())
        return functional_call(self._backbone, backbone, (images.to(dtype),), strict=True)

    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        out = functional_call(self._predictor, trainable, (features,), strict=True)
        return out["cls_logits"], out["bbox_regression"]

    def check_labels(self, labels: Tensor) -> None:
        """Raises ``ValueError`` where a label is not below ``num_classes``."""
        if labels.numel() and int(labels.max()) >= self.num_classes:
            raise ValueError(f"assign: labels want to be below {self.num_classes}, got {int(labels.max())}")


def check_common(num_classes: int, activation: str, proximal: float) -> None:
    """Raises ``ValueError`` for one of these that is out of its range."""
    check(
        "detector",
        num_classes=(num_classes, num_classes >= 1, "at least 1"),
        activation=(activation, activation in ACTIVATIONS, f"one of {tuple(ACTIVATIONS)}"),
        proximal=(proximal, 0 <= proximal < math.inf, "finite and at least 0"),
    )


def _coarser(own: tuple[int, ...], strides: tuple[int, ...], available: tuple[int, ...]) -> tuple[int, ...]:
    """Strides of the levels past the backbone's last, where as many as there are may follow it."""
    last, count = available[-1], len(strides) - len(own)
    return tuple(last * 2**n for n in range(1, count + 1)) if last in own else ()
