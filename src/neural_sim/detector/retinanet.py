"""RetinaNet (Lin et al. 2017) as pure functions of a parameter dictionary.

The network is torchvision's feature pyramid and head on a backbone; the modules here are only its shape. Their
values always come in as an argument, so that training losses can be differentiated any number of times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import functional_call
from torchvision.models.detection._utils import BoxCoder
from torchvision.ops import batched_nms, clip_boxes_to_image

from neural_sim.detector.backbones import ACTIVATIONS, IMAGENET_MEAN, IMAGENET_STD, build_backbone
from neural_sim.detector.initialise import initialise
from neural_sim.detector.losses import box_loss, focal_loss
from neural_sim.detector.network import NormalisedBackbone, build_predictor, fixed_anchors
from neural_sim.detector.protocol import Best, Outputs, Parameters
from neural_sim.detector.settings import (
    ARCHITECTURES,
    SAVED,
    Anchors,
    Backbone,
    Detections,
    Head,
    Losses,
    check,
)
from neural_sim.detector.targets import IGNORED, Targets, assign_anchors


class RetinaNet:
    """A RetinaNet for images of one size; holds its shape, its anchors and its loss, never its parameters.

    ``normalisation`` is what the backbone does first to the channels (red, green, blue) of images in [0, 1].

    Args:
        num_classes: classes, from 0, without a background class.
        image_size: (height, width) in pixels, or one number for a square.
        activation: ``silu`` or ``relu`` (torchvision's own), of backbone, pyramid and head.
        proximal: lambda of ``lambda / 2 |theta - theta_0|^2`` in the psi loop's inner problem, theta_0 the warm start.

    Raises:
        ValueError: any of these out of its range, or strides that the backbone does not have, with the key and value.
    """

    normalisation: ClassVar[dict[str, tuple[float, ...]]] = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}

    def __init__(
        self,
        num_classes: int,
        image_size: int | tuple[int, int] = 96,
        backbone: Backbone = Backbone(),
        head: Head = Head(),
        anchors: Anchors = Anchors(),
        losses: Losses = Losses(),
        detections: Detections = Detections(),
        activation: str = "silu",
        proximal: float = 0.0,
    ) -> None:
        strides, available = tuple(anchors.strides), ARCHITECTURES[backbone.architecture]
        own = tuple(stride for stride in strides if stride in available)
        check(
            "detector",
            num_classes=(num_classes, num_classes >= 1, "at least 1"),
            activation=(activation, activation in ACTIVATIONS, f"one of {tuple(ACTIVATIONS)}"),
            proximal=(proximal, 0 <= proximal < math.inf, "finite and at least 0"),
        )
        check(
            "detector.anchors",
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
        self.proximal = proximal
        self._settings, self._head, self._losses, self.detections = backbone, head, losses, detections
        self._overlaps = anchors.foreground_iou, anchors.background_iou
        network = build_backbone(backbone.architecture, own, activation, backbone.weights)
        widths = [network.channels[stride] for stride in own]
        self._backbone = NormalisedBackbone(network)
        per_location = len(anchors.sizes[0]) * len(anchors.ratios)
        self._predictor = build_predictor(widths, len(strides), per_location, num_classes, head, activation)
        self.anchors, self.anchors_per_level = fixed_anchors(anchors, self.image_size)

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

    def split(self, params: Parameters) -> tuple[Parameters, Parameters]:
        """Parameters of the backbone, frozen in the psi loop, and of the pyramid and head, trained in it."""
        backbone = {name: value for name, value in params.items() if name.startswith("backbone.")}
        return backbone, {name: value for name, value in params.items() if name not in backbone}

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
        """Class logits and encoded boxes of every anchor."""
        out = functional_call(self._predictor, trainable, (features,), strict=True)
        return out["cls_logits"], out["bbox_regression"]

    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """Targets of every anchor, see :func:`targets.assign_anchors`.

        Raises:
            ValueError: where a label is not below ``num_classes``, or a box has no area.
        """
        if labels.numel() and int(labels.max()) >= self.num_classes:
            raise ValueError(f"assign: labels want to be below {self.num_classes}, got {int(labels.max())}")
        return assign_anchors(self.anchors.to(boxes), boxes, labels, *self._overlaps)

    def per_image_loss(
        self, trainable: Parameters, features: Sequence[Tensor], targets: Targets
    ) -> Float[Tensor, "n"]:
        """Losses of the outputs. A jvp along v gives every image's score <dl_i / dtheta, v> in one pass."""
        return self.losses_of(self.outputs(trainable, features), targets)

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Focal loss plus box loss of each image, each a sum over anchors by the number of foreground anchors."""
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

    def best(self, outputs: Outputs, per_class: int, candidates: int = 100) -> Best:
        """At most ``per_class`` detections of each class in each image, of its ``candidates`` best logits after
        non-maximum suppression. No score is too low: a box that is missed today should be able to rise."""
        logits, deltas = outputs
        top, index = logits.detach().flatten(1).topk(min(candidates, logits[0].numel()))
        image = torch.arange(len(top), device=top.device)[:, None].expand_as(index).flatten()
        anchor, label = (index // self.num_classes).flatten(), (index % self.num_classes).flatten()
        group = image * self.num_classes + label
        kept = batched_nms(
            self._decoded(deltas.detach()[image, anchor], anchor),
            top.flatten(),
            group,
            self.detections.nms_iou,
        )
        kept = kept[group[kept].argsort(stable=True)]
        place = torch.arange(len(kept), device=kept.device) - torch.searchsorted(group[kept], group[kept])
        image, anchor, label = (part[kept[place < per_class]] for part in (image, anchor, label))
        boxes = self._decoded(deltas[image, anchor], anchor)
        return Best(image, label, logits[image, anchor, label], boxes)

    def decode(self, deltas: Float[Tensor, "n anchors 4"]) -> Float[Tensor, "n anchors 4"]:
        """The boxes of all anchors (x0, y0, x1, y1) in pixels, within the image."""
        anchors = self.anchors.to(deltas).expand(deltas.shape[0], -1, -1).reshape(-1, 4)
        boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(deltas.reshape(-1, 4), anchors)
        return clip_boxes_to_image(boxes, self.image_size).reshape(deltas.shape)

    def _decoded(self, deltas: Float[Tensor, "m 4"], anchor: Int[Tensor, "m"]) -> Float[Tensor, "m 4"]:
        """Boxes in pixels, within the image."""
        boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(deltas, self.anchors.to(deltas)[anchor])
        return clip_boxes_to_image(boxes, self.image_size)

    @torch.no_grad()
    def predict(
        self, params: Parameters, images: Float[Tensor, "n 3 h w"], batch_size: int = 64
    ) -> list[dict[str, Tensor]]:
        """Detections of each image, best first, on the CPU: boxes [d, 4] in pixels, scores [d], labels [d]; see
        :class:`Detections`."""
        backbone, trainable = self.split(params)
        detections, device = [], next(iter(trainable.values())).device
        for chunk in images.split(batch_size) if len(images) else ():
            logits, deltas = self.outputs(trainable, self.features(backbone, chunk.to(device)))
            detections += self._chosen(logits.sigmoid(), deltas)
        return detections

    def _chosen(
        self, scores: Float[Tensor, "n anchors classes"], deltas: Float[Tensor, "n anchors 4"]
    ) -> list[dict[str, Tensor]]:
        """The candidates of all images are chosen together and taken to the CPU, where each image has its own few."""
        levels = []
        for level, first in zip(scores.split(self.anchors_per_level, 1), self._first_anchors, strict=True):
            best, index = level.flatten(1).topk(min(self.detections.candidates, level[0].numel()))
            levels.append((best, index + first * self.num_classes))
        best, index = (torch.cat(part, 1) for part in zip(*levels, strict=True))
        anchor, labels = index // self.num_classes, index % self.num_classes
        moves = deltas.gather(1, anchor[..., None].expand(-1, -1, 4))
        chosen = (part.cpu() for part in (best, anchor, labels, moves))
        return [self._suppressed(*image) for image in zip(*chosen, strict=True)]

    def _suppressed(self, best: Tensor, anchor: Tensor, labels: Tensor, moves: Tensor) -> dict[str, Tensor]:
        """One image's detections of its candidates."""
        keep = best > self.detections.score_threshold
        best, anchor, labels, moves = (part[keep] for part in (best, anchor, labels, moves))
        boxes = self._decoded(moves, anchor)
        keep = batched_nms(boxes, best, labels, self.detections.nms_iou)[: self.detections.limit]
        return {"boxes": boxes[keep], "scores": best[keep], "labels": labels[keep]}

    @property
    def _first_anchors(self) -> list[int]:
        return [sum(self.anchors_per_level[:level]) for level in range(len(self.anchors_per_level))]


def _coarser(own: tuple[int, ...], strides: tuple[int, ...], available: tuple[int, ...]) -> tuple[int, ...]:
    """Strides of the levels past the backbone's last, where as many as there are may follow it."""
    last, count = available[-1], len(strides) - len(own)
    return tuple(last * 2**n for n in range(1, count + 1)) if last in own else ()
