"""RetinaNet (Lin et al. 2017) as pure functions of a parameter dictionary.

The network is torchvision's feature pyramid and head on a backbone; the modules here are only its shape. Their
values always come in as an argument, so that training losses can be differentiated any number of times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import functional_call
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.ops import batched_nms, clip_boxes_to_image

from neural_sim.detector.backbones import ACTIVATIONS, build_backbone
from neural_sim.detector.initialise import initialise
from neural_sim.detector.losses import BOX_LOSSES, box_loss, focal_loss
from neural_sim.detector.network import Normalisation, NormalisedBackbone, build_predictor, fixed_anchors
from neural_sim.detector.targets import IGNORED, Targets, assign_anchors

Parameters = dict[str, Tensor]
Outputs = tuple[Float[Tensor, "n anchors classes"], Float[Tensor, "n anchors 4"]]
ARCHITECTURES = {
    "micro": (8, 16),
    "tiny": (8, 16),
    "resnet18": (4, 8, 16, 32),
    "resnet50": (4, 8, 16, 32),
}
"""Strides of the backbones' maps."""


class Detector:
    """A RetinaNet for images of one size; holds its shape, its anchors and its loss, never its parameters.

    Args:
        num_classes: classes, from 0, without a background class.
        image_size: (height, width) in pixels, or one number for a square.
        architecture: ``micro``, ``tiny``, ``resnet18`` or ``resnet50``.
        weights: of the ResNets' backbone: None, a file with a torchvision state dictionary, or torchvision's
            name of the weights.
        freeze_backbone: the backbone keeps ``weights`` in every training. It is always frozen in the psi loop.
        activation: ``silu`` or ``relu`` (torchvision's own).
        box_loss: ``pseudo_huber`` or ``l1`` (torchvision's own).
        box_loss_delta: scale of the pseudo-Huber loss, in encoded units.
        strides: of the pyramid's levels, from 4, 8, 16 and 32 (micro and tiny: 8 and 16), then twice the last for each
            of any coarser levels, see :class:`network.CoarserLevels`.
        anchor_sizes: per level, side of the square of an anchor's area, in pixels of an image whose shorter side
            is ``anchor_reference``; they scale with the image's.
        anchor_reference: that side in pixels; None: sizes are pixels of any image, as in torchvision.
        aspect_ratios: of every anchor, height / width.
        channels: of the pyramid and the head, a multiple of 8.
        head_convs: convolutions in each branch of the head, 1 to 4.
        normalisation: of the pyramid and the head, ``group`` or ``none`` (torchvision's own).
        focal_alpha, focal_gamma: of the focal loss.
        prior_probability: foreground probability that the untrained head predicts.
        foreground_iou, background_iou: overlaps from which an anchor is foreground, below which background.
        score_threshold, nms_iou, max_detections, max_candidates: of the detections, see :meth:`predict`.
        proximal: lambda of ``lambda / 2 |theta - theta_0|^2`` in the psi loop's inner problem, theta_0 the warm start.

    Raises:
        ValueError: any of these out of its range, with the key and the value.
    """

    def __init__(
        self,
        num_classes: int,
        image_size: int | tuple[int, int] = 96,
        architecture: str = "tiny",
        weights: str | None = None,
        freeze_backbone: bool = False,
        activation: str = "silu",
        box_loss: str = "pseudo_huber",
        box_loss_delta: float = 0.1,
        strides: Sequence[int] = (8, 16),
        anchor_sizes: Sequence[Sequence[float]] = ((22, 28, 36), (46, 58, 74)),
        anchor_reference: float | None = 96,
        aspect_ratios: Sequence[float] = (1.0,),
        channels: int = 48,
        head_convs: int = 2,
        normalisation: Normalisation = "group",
        focal_alpha: float = 0.25,
        focal_gamma: float = 2.0,
        prior_probability: float = 0.01,
        foreground_iou: float = 0.5,
        background_iou: float = 0.4,
        score_threshold: float = 0.05,
        nms_iou: float = 0.5,
        max_detections: int = 100,
        max_candidates: int = 1000,
        proximal: float = 0.0,
    ) -> None:
        strides = tuple(strides)
        _check(
            architecture=(architecture, architecture in ARCHITECTURES, f"one of {tuple(ARCHITECTURES)}"),
            num_classes=(num_classes, num_classes >= 1, "at least 1"),
            activation=(activation, activation in ACTIVATIONS, f"one of {tuple(ACTIVATIONS)}"),
            box_loss=(box_loss, box_loss in BOX_LOSSES, f"one of {BOX_LOSSES}"),
            box_loss_delta=(box_loss_delta, box_loss_delta > 0, "above 0"),
            channels=(channels, channels >= 8 and channels % 8 == 0, "a positive multiple of 8"),
            head_convs=(head_convs, 1 <= head_convs <= 4, "1 to 4"),
            prior_probability=(prior_probability, 0 < prior_probability < 1, "inside (0, 1)"),
            normalisation=(
                normalisation,
                normalisation in get_args(Normalisation),
                f"one of {get_args(Normalisation)}",
            ),
            anchor_reference=(
                anchor_reference,
                anchor_reference is None or anchor_reference > 0,
                "above 0, or null",
            ),
            freeze_backbone=(
                freeze_backbone,
                not freeze_backbone or weights is not None,
                "detector.weights too, since a frozen backbone without them is random",
            ),
            proximal=(proximal, 0 <= proximal < math.inf, "finite and at least 0"),
            anchor_sizes=(anchor_sizes, len(anchor_sizes) == len(strides), "one list for each stride"),
            foreground_iou=(foreground_iou, background_iou <= foreground_iou <= 1, "background_iou up to 1"),
        )
        own = tuple(stride for stride in strides if stride in ARCHITECTURES[architecture])
        _check(
            strides=(
                strides,
                len(own) > 0
                and own == tuple(sorted(set(own)))
                and strides[len(own) :] == _coarser(own, strides, architecture),
                f"an ascending choice of {ARCHITECTURES[architecture]} for {architecture}, and from its last on "
                "coarser ones, each twice the one before",
            )
        )
        self.num_classes = num_classes
        height, width = (image_size, image_size) if isinstance(image_size, int) else image_size
        self.image_size = (height, width)
        self.box_loss, self.box_loss_delta = box_loss, box_loss_delta
        self.focal_alpha, self.focal_gamma = focal_alpha, focal_gamma
        self.prior_probability = prior_probability
        self.foreground_iou, self.background_iou = foreground_iou, background_iou
        self.proximal = proximal
        self.score_threshold, self.nms_iou = score_threshold, nms_iou
        self.max_detections, self.max_candidates = max_detections, max_candidates
        self.freeze_backbone = freeze_backbone
        backbone = build_backbone(architecture, own, activation, weights)
        scale = 1.0 if anchor_reference is None else min(self.image_size) / anchor_reference
        sizes = tuple(tuple(scale * size for size in level) for level in anchor_sizes)
        generator = AnchorGenerator(sizes, (tuple(aspect_ratios),) * len(sizes))
        self._backbone = NormalisedBackbone(backbone)
        self._predictor = build_predictor(
            [backbone.channels[stride] for stride in own],
            channels,
            generator.num_anchors_per_location(),
            num_classes,
            head_convs,
            activation,
            normalisation,
        )
        self._pretrained = weights is not None
        self.anchors, self.anchors_per_level = fixed_anchors(generator, self.image_size, strides)

    def init(self, generator: torch.Generator) -> Parameters:
        """Fresh parameters in float32 on the CPU; pretrained backbones keep their weights.

        The dictionary also holds a frozen batch normalisation's statistics, so that it is complete.
        """
        backbone = self._backbone.state_dict()
        if not self._pretrained:
            backbone = initialise(self._backbone, generator)
        predictor = initialise(self._predictor, generator, self.prior_probability)
        return {name: value.detach().clone() for name, value in {**backbone, **predictor}.items()}

    def split(self, params: Parameters) -> tuple[Parameters, Parameters]:
        """Parameters of the backbone, frozen in the psi loop, and of the pyramid and head, trained in it."""
        backbone = {name: value for name, value in params.items() if name.startswith("backbone.")}
        return backbone, {name: value for name, value in params.items() if name not in backbone}

    def learnable(self, params: Parameters) -> list[str]:
        """Names of everything that a full training changes: all but frozen statistics or a frozen backbone."""
        learned = (self._predictor,) if self.freeze_backbone else (self._backbone, self._predictor)
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
        return assign_anchors(self.anchors.to(boxes), boxes, labels, self.foreground_iou, self.background_iou)

    def per_image_loss(
        self, trainable: Parameters, features: Sequence[Tensor], targets: Targets
    ) -> Float[Tensor, "n"]:
        """Losses of the outputs. A jvp along v gives every image's score <dl_i / dtheta, v> in one pass."""
        return self.losses_of(self.outputs(trainable, features), targets)

    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Focal loss plus box loss of each image, each a sum over anchors by the number of foreground anchors."""
        logits, deltas = outputs
        labels = targets.labels
        classes = torch.arange(self.num_classes, device=labels.device)
        wanted = (labels[..., None] == classes).to(logits.dtype)
        foreground = (labels >= 0).to(logits.dtype)
        counted = (labels != IGNORED).to(logits.dtype)
        focal = focal_loss(logits, wanted, self.focal_alpha, self.focal_gamma).sum(-1) * counted
        residual = deltas - targets.deltas.to(deltas.dtype)
        regression = box_loss(residual, self.box_loss, self.box_loss_delta).sum(-1) * foreground
        return (focal + regression).sum(-1) / foreground.sum(-1).clamp(min=1)

    def loss(self, trainable: Parameters, features: Sequence[Tensor], targets: Targets) -> Float[Tensor, ""]:
        """Mean of :meth:`per_image_loss`: L of the paper's Eq. 2, without any regulariser."""
        return self.per_image_loss(trainable, features, targets).mean()

    @torch.no_grad()
    def predict(
        self, params: Parameters, images: Float[Tensor, "n 3 h w"], batch_size: int = 64
    ) -> list[dict[str, Tensor]]:
        """Detections of each image, best first, on the CPU: boxes [d, 4] in pixels, scores [d], labels [d].

        Per level, the ``max_candidates`` best scores above ``score_threshold``; then non-maximum suppression
        within each class at ``nms_iou``, and the best ``max_detections`` are kept.
        """
        backbone, trainable = self.split(params)
        found, device = [], next(iter(trainable.values())).device
        for chunk in images.split(batch_size) if len(images) else ():
            logits, deltas = self.outputs(trainable, self.features(backbone, chunk.to(device)))
            found += self._detections(logits.sigmoid(), deltas)
        return found

    def _detections(
        self, scores: Float[Tensor, "n anchors classes"], deltas: Float[Tensor, "n anchors 4"]
    ) -> list[dict[str, Tensor]]:
        """The candidates of all images are chosen together and taken to the CPU, where each image has its own few."""
        levels = []
        for level, first in zip(scores.split(self.anchors_per_level, 1), self._first_anchors, strict=True):
            best, index = level.flatten(1).topk(min(self.max_candidates, level[0].numel()))
            levels.append((best, index + first * self.num_classes))
        best, index = (torch.cat(part, 1) for part in zip(*levels, strict=True))
        anchor, labels = index // self.num_classes, index % self.num_classes
        moves = deltas.gather(1, anchor[..., None].expand(-1, -1, 4))
        chosen = (part.cpu() for part in (best, anchor, labels, moves))
        return [self._suppressed(*image) for image in zip(*chosen, strict=True)]

    def _suppressed(self, best: Tensor, anchor: Tensor, labels: Tensor, moves: Tensor) -> dict[str, Tensor]:
        """One image's detections of its candidates."""
        keep = best > self.score_threshold
        best, anchor, labels, moves = (part[keep] for part in (best, anchor, labels, moves))
        boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(moves, self.anchors.to(moves)[anchor])
        boxes = clip_boxes_to_image(boxes, self.image_size)
        keep = batched_nms(boxes, best, labels, self.nms_iou)[: self.max_detections]
        return {"boxes": boxes[keep], "scores": best[keep], "labels": labels[keep]}

    @property
    def _first_anchors(self) -> list[int]:
        return [sum(self.anchors_per_level[:level]) for level in range(len(self.anchors_per_level))]


def _coarser(own: tuple[int, ...], strides: tuple[int, ...], architecture: str) -> tuple[int, ...]:
    """Strides of the levels past the backbone's last, where as many as there are may follow it."""
    last, count = ARCHITECTURES[architecture][-1], len(strides) - len(own)
    return tuple(last * 2**n for n in range(1, count + 1)) if last in own else ()


def _check(**conditions: tuple[object, bool, str]) -> None:
    for key, (got, holds, wanted) in conditions.items():
        if not holds:
            raise ValueError(f"detector.{key}: want {wanted}, got {got!r}")
