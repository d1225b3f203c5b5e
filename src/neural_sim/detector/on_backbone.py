"""Base classes of detectors with a backbone: initial values, trained parameters, image features.

The modules here only define the network's shape. Parameter values are always passed in as an argument, so that training
losses can be differentiated any number of times. Most detectors add torchvision's feature pyramid and one head, which
all its levels share.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call
from typing_extensions import override

from neural_sim.detector.network import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    PLANS,
    LastStages,
    NormalisedBackbone,
    build_backbone,
    build_predictor,
    initialise,
)
from neural_sim.detector.protocol import Detector, Outputs, Parameters
from neural_sim.detector.settings import ARCHITECTURES, SAVED, Activation, Backbone, Detections, Head
from neural_sim.ranges import NonNegative, PositiveInt, validated

ImageSize = PositiveInt | tuple[PositiveInt, PositiveInt]
"""(height, width) in pixels, or one number for a square."""


@validated
class BackboneDetector(Detector):
    """A detector whose images pass through a backbone. A subclass sets ``_predictor``, which takes the features.

    ``normalisation`` has the mean and the standard deviation of each channel (red, green, blue), by which the backbone
    first normalises images in [0, 1].

    Args:
        num_classes: number of classes, counted from 0, without a background class.
        image_size: (height, width) in pixels, or one number for a square.
        backbone: settings of the backbone.
        strides: strides of the maps that serve as features, ascending.
        activation: ``silu`` or ``relu`` (torchvision's own).
        proximal: see ``Detector``.
        prior: foreground probability that the untrained predictor outputs; None: it has no such output.

    Raises:
        ValueError: the backbone's weights cannot be loaded, see ``network.load_weights``.
    """

    normalisation: ClassVar[dict[str, tuple[float, ...]]] = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
    _predictor: nn.Module

    def __init__(
        self,
        num_classes: PositiveInt,
        image_size: ImageSize,
        backbone: Backbone,
        strides: Sequence[int],
        activation: Activation,
        proximal: NonNegative,
        prior: float | None = None,
    ) -> None:
        self.num_classes = num_classes
        height, width = (image_size, image_size) if isinstance(image_size, int) else image_size
        self.image_size = (height, width)
        self.proximal, self._settings, self._prior = proximal, backbone, prior
        self._body = body = build_backbone(
            backbone.architecture, tuple(strides), activation, backbone.weights
        )
        self._backbone = self._first = NormalisedBackbone(body)
        self._last: LastStages | None = None
        self._widths = [body.channels[stride] for stride in strides]

    def in_loop(self, layers: int | None) -> BackboneDetector:
        """Return the detector as the psi loop trains it, with the last ``layers`` stages of its backbone.

        By default (None), it trains one stage of the small backbones, and none of a ResNet, whose last stages have
        millions of parameters.

        Raises:
            ValueError: the backbone has pretrained weights, so its normalisation is frozen; or ``layers`` is negative
                or not below the backbone's number of stages.
        """
        if layers is None:
            layers = int(self._settings.architecture in PLANS)
        if layers == 0:
            return self
        if self._settings.weights is not None:
            raise ValueError(
                f"outer.loop_layers: want null or 0 with detector.backbone.weights, got {layers}"
            )
        looped = copy.copy(self)
        first, looped._last = self._body.divided(layers)
        looped._first = NormalisedBackbone(first)
        return looped

    def init(self, generator: torch.Generator) -> Parameters:
        """Draw parameters in float32 on the CPU; pretrained backbones keep their weights.

        The dictionary is complete: it includes the statistics of a frozen batch normalisation.

        Raises:
            ValueError: the detector was read from a model file, which already has its parameters.
        """
        if self._settings.weights == SAVED:
            raise ValueError(
                f"detector.backbone.weights: {SAVED!r} is for detectors that are read from a model file; want null, "
                "a file or a name of torchvision's"
            )
        backbone = self._backbone.state_dict()
        if self._settings.weights is None:
            backbone = initialise(self._backbone, generator)
        predictor = initialise(self._predictor, generator, self._prior)
        return {name: value.detach().clone() for name, value in {**backbone, **predictor}.items()}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of all parameters, by name."""
        state = {**self._backbone.state_dict(), **self._predictor.state_dict()}
        return {name: tuple(value.shape) for name, value in state.items()}

    def learnable(self, params: Parameters) -> list[str]:
        """Name the parameters that a full training changes: all except frozen statistics or a frozen backbone."""
        learned = (self._predictor,) if self._settings.freeze else (self._backbone, self._predictor)
        names = {n for module in learned for n, _ in module.named_parameters()}
        return [name for name in params if name in names]

    def split(self, params: Parameters) -> tuple[Parameters, Parameters]:
        """Separate the backbone's parameters from all others, which include any stages that the psi loop trains."""
        last = set() if self._last is None else {name for name, _ in self._last.named_parameters()}
        backbone = {n: value for n, value in params.items() if n.startswith("backbone.") and n not in last}
        return backbone, {name: value for name, value in params.items() if name not in backbone}

    def features(self, backbone: Parameters, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """Compute the map [n, c, h / stride, w / stride] of each level.

        In the psi loop, which trains the last stages, these are the maps before those stages.

        Raises:
            ValueError: the images do not have the detector's size.
        """
        if tuple(images.shape[-3:]) != (3, *self.image_size):
            height, width = self.image_size
            raise ValueError(
                f"detector: want images of shape [n, 3, {height}, {width}], got {list(images.shape)}"
            )
        dtype = next(value.dtype for value in backbone.values() if value.is_floating_point())
        return functional_call(self._first, backbone, (images.to(dtype),), strict=True)

    def completed(
        self, trainable: Parameters, features: Sequence[Tensor]
    ) -> tuple[Parameters, Sequence[Tensor]]:
        """Return the predictor's parameters, and all maps of the backbone."""
        if self._last is None:
            return trainable, features
        last = {name: value for name, value in trainable.items() if name.startswith("backbone.")}
        predictor = {name: value for name, value in trainable.items() if name not in last}
        return predictor, functional_call(self._last, last, (tuple(features),), strict=True)

    def check_labels(self, labels: Tensor) -> None:
        """Check that labels are below ``num_classes``.

        Raises:
            ValueError: some label is not.
        """
        if labels.numel() and int(labels.max()) >= self.num_classes:
            raise ValueError(f"assign: want labels below {self.num_classes}, got {int(labels.max())}")


class PyramidDetector(BackboneDetector):
    """A backbone, a feature pyramid and a head; a subclass provides the head, the targets and the losses.

    Args:
        head: settings of the head and the pyramid.
        strides: strides of the pyramid's levels.
        where: configuration key that holds the strides, for messages.
        network: the head's module, with ``Head.channels`` channels; it returns ``cls_logits`` [n, anchors, classes]
            and ``bbox_regression`` [n, anchors, code].
        activation: ``silu`` or ``relu`` (torchvision's own), for backbone, pyramid and head.
        detections: see ``Detector``.

    See ``BackboneDetector`` for the other arguments.

    Raises:
        ValueError: the backbone does not have these strides; the message names the key and the value.
    """

    def __init__(
        self,
        num_classes: PositiveInt,
        image_size: ImageSize,
        backbone: Backbone,
        head: Head,
        strides: Sequence[int],
        where: str,
        network: nn.Module,
        detections: Detections,
        activation: Activation,
        proximal: NonNegative,
    ) -> None:
        strides, available = tuple(strides), ARCHITECTURES[backbone.architecture]
        own = tuple(stride for stride in strides if stride in available)
        rising = len(own) > 0 and own == tuple(sorted(set(own)))
        if not rising or strides[len(own) :] != _coarser(own, strides, available):
            raise ValueError(
                f"{where}.strides: want an ascending choice of {available} for {backbone.architecture}; after its "
                f"last, coarser ones may follow, each twice the one before; got {strides}"
            )
        super().__init__(num_classes, image_size, backbone, own, activation, proximal, head.prior)
        self.detections = detections
        self._predictor = build_predictor(self._widths, len(strides), network, head, activation)

    @override
    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        predictor, maps = self.completed(trainable, features)
        out = functional_call(self._predictor, predictor, (maps,), strict=True)
        return out["cls_logits"], out["bbox_regression"]


def _coarser(own: tuple[int, ...], strides: tuple[int, ...], available: tuple[int, ...]) -> tuple[int, ...]:
    """Return the strides of the levels coarser than the backbone's last map; none if that map is not used."""
    last, count = available[-1], len(strides) - len(own)
    return tuple(last * 2**n for n in range(1, count + 1)) if last in own else ()
