"""Settings of detectors, by component."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MinLen, MultipleOf

from neural_sim.ranges import Ascending, Fraction, NonNegative, Positive, PositiveInt, validated

Architecture = Literal["micro", "tiny", "resnet18", "resnet50"]
Activation = Literal["silu", "relu"]
"""Activation of backbone, pyramid and head; relu is torchvision's own."""
BetweenZeroAndOne = Annotated[float, Gt(0), Lt(1)]
Normalisation = Literal["group", "none"]
"""Normalisation of the pyramid and the head, see ``network.group_norm``."""
BoxLoss = Literal["pseudo_huber", "l1"]
ARCHITECTURES: dict[Architecture, tuple[int, ...]] = {
    "micro": (8, 16),
    "tiny": (8, 16),
    "resnet18": (4, 8, 16, 32),
    "resnet50": (4, 8, 16, 32),
}
"""Strides of the backbones' maps."""
SAVED = "saved"
"""``Backbone.weights`` of a detector read from a model file, which contains the values."""


@validated
@dataclass(frozen=True)
class Backbone:
    """The network that turns images into feature maps.

    Args:
        architecture: name of the network.
        weights: initial weights of a ResNet: None (random), a file with a torchvision state dictionary, or
            torchvision's name of the weights. Model files say ``saved`` if the backbone had weights.
        freeze: train only the predictor, in every training. For the psi loop see ``outer.loop_layers``.
    """

    architecture: Architecture = "tiny"
    weights: str | None = None
    freeze: bool = False

    def __post_init__(self) -> None:
        if self.freeze and self.weights is None:
            raise ValueError(
                "Backbone.weights: want weights with freeze=true, because without them the backbone is random; got None"
            )


@validated
@dataclass(frozen=True)
class Head:
    """The feature pyramid, and the head that all its levels share.

    Args:
        channels: width of the pyramid and the head.
        convs: number of convolutions in each branch of the head.
        normalisation: normalisation of the pyramid and the head, ``group`` or ``none`` (torchvision's own).
        prior: foreground probability that the untrained head predicts.
    """

    channels: Annotated[int, Ge(8), MultipleOf(8)] = 48
    convs: Annotated[int, Ge(1), Le(4)] = 2
    normalisation: Normalisation = "group"
    prior: BetweenZeroAndOne = 0.01


@validated
@dataclass(frozen=True)
class Anchors:
    """The anchor boxes, and how they are assigned to objects.

    Args:
        strides: strides of the pyramid's levels, chosen from 4, 8, 16 and 32 (micro and tiny: 8 and 16), then doubled
            for each coarser level, see ``network.CoarserLevels``.
        sizes: for each level, the square roots of the anchors' areas, in pixels of an image whose shorter side is
            ``reference``; they scale with the image.
        reference: that side in pixels; None: sizes are in pixels of any image, as in torchvision.
        ratios: aspect ratios of the anchors, height / width.
        foreground_iou, background_iou: overlaps from which an anchor is foreground, and below which it is background.
    """

    strides: Annotated[Sequence[PositiveInt], MinLen(1)] = (8, 16)
    sizes: Sequence[Annotated[Sequence[Positive], MinLen(1)]] = ((22, 28, 36), (46, 58, 74))
    reference: Positive | None = 96
    ratios: Annotated[Sequence[Positive], MinLen(1)] = (1.0,)
    foreground_iou: Fraction = 0.5
    background_iou: Fraction = 0.4

    def __post_init__(self) -> None:
        counts = [len(level) for level in self.sizes]
        if len(counts) != len(self.strides) or len(set(counts)) > 1:
            raise ValueError(
                f"Anchors.sizes: want one list for each stride, all of them equally long, got {self.sizes}"
            )
        if self.foreground_iou < self.background_iou:
            raise ValueError(
                f"Anchors.foreground_iou: want at least background_iou={self.background_iou}, "
                f"got {self.foreground_iou}"
            )


@validated
@dataclass(frozen=True)
class Points:
    """The points of an FCOS, and how they are assigned to objects.

    Args:
        strides: strides of the pyramid's levels, as in ``Anchors``; a level has one point per stride.
        limits: for all levels but the last, the largest distance from a point to the farthest side of its box, in
            pixels of an image whose shorter side is ``reference``; larger distances belong to the next level.
        reference: that side in pixels; None: limits are in pixels of any image.
        radius: a point detects a box only if the box's centre is less than this many strides away, along each axis.
    """

    strides: Sequence[PositiveInt] = (8, 16)
    limits: Annotated[Sequence[Positive], Ascending(strictly=True)] = (28,)
    reference: Positive | None = 96
    radius: Positive = 1.5

    def __post_init__(self) -> None:
        if len(self.limits) != len(self.strides) - 1:
            raise ValueError(f"Points.limits: want one for each stride but the last, got {list(self.limits)}")

    def ranges(self, shorter_side: float) -> list[tuple[float, float]]:
        """Return each level's range of distances to the farthest side, in pixels of an image of this size."""
        scale = 1.0 if self.reference is None else shorter_side / self.reference
        bounds = [0.0, *(scale * limit for limit in self.limits), float("inf")]
        return list(itertools.pairwise(bounds))


@validated
@dataclass(frozen=True)
class Losses:
    """The loss of an anchor's prediction.

    Args:
        box: ``pseudo_huber`` or ``l1`` (torchvision's own).
        box_delta: delta of the pseudo-Huber loss, in units of the box code (centre shifts in anchor sides, log size
            ratios).
        focal_alpha, focal_gamma: alpha and gamma of the focal loss (Lin et al. 2017, Eq. 5).
    """

    box: BoxLoss = "pseudo_huber"
    box_delta: Positive = 0.1
    focal_alpha: BetweenZeroAndOne = 0.25
    focal_gamma: NonNegative = 2.0


@validated
@dataclass(frozen=True)
class Detections:
    """How detections are selected from predictions.

    Each level's ``candidates`` best scores, if above ``score_threshold``, go through non-maximum suppression within
    each class at ``nms_iou``; the best ``limit`` of an image are kept.
    """

    score_threshold: Annotated[float, Ge(0), Lt(1)] = 0.05
    nms_iou: Fraction = 0.5
    limit: PositiveInt = 100
    candidates: PositiveInt = 1000
