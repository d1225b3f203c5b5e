"""The settings of detectors, by component."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Normalisation = Literal["group", "none"]
"""Of the pyramid and the head, see :func:`backbones.group_norm`."""
BoxLoss = Literal["pseudo_huber", "l1"]
ARCHITECTURES = {
    "micro": (8, 16),
    "tiny": (8, 16),
    "resnet18": (4, 8, 16, 32),
    "resnet50": (4, 8, 16, 32),
}
"""Strides of the backbones' maps."""
SAVED = "saved"
"""``Backbone.weights`` of a detector that is read from a model file, which has their values."""


@dataclass(frozen=True)
class Backbone:
    """The network that makes feature maps of images.

    Args:
        architecture: ``micro``, ``tiny``, ``resnet18`` or ``resnet50``.
        weights: initial weights of a ResNet: None (random), a file with a torchvision state dictionary, or
            torchvision's name of the weights. Model files have ``saved``: the shape of a backbone that had weights.
        freeze: train the predictor only, in every training. Of the psi loop see ``outer.loop_layers``.
    """

    architecture: str = "tiny"
    weights: str | None = None
    freeze: bool = False

    def __post_init__(self) -> None:
        check(
            "detector.backbone",
            architecture=(
                self.architecture,
                self.architecture in ARCHITECTURES,
                f"one of {tuple(ARCHITECTURES)}",
            ),
            freeze=(
                self.freeze,
                not self.freeze or self.weights is not None,
                "detector.backbone.weights too, since a frozen backbone without them is random",
            ),
        )


@dataclass(frozen=True)
class Head:
    """The feature pyramid, and the head that is applied to all its levels.

    Args:
        channels: width of both, a multiple of 8.
        convs: convolutions in each branch of the head, 1 to 4.
        normalisation: of both, ``group`` or ``none`` (torchvision's own).
        prior: foreground probability that the untrained head predicts.
    """

    channels: int = 48
    convs: int = 2
    normalisation: Normalisation = "group"
    prior: float = 0.01

    def __post_init__(self) -> None:
        kinds = get_args(Normalisation)
        check(
            "detector.head",
            channels=(
                self.channels,
                self.channels >= 8 and self.channels % 8 == 0,
                "a positive multiple of 8",
            ),
            convs=(self.convs, 1 <= self.convs <= 4, "1 to 4"),
            normalisation=(self.normalisation, self.normalisation in kinds, f"one of {kinds}"),
            prior=(self.prior, 0 < self.prior < 1, "inside (0, 1)"),
        )


@dataclass(frozen=True)
class Anchors:
    """The boxes that predictions start from, and which of them should find which object.

    Args:
        strides: of the pyramid's levels, from 4, 8, 16 and 32 (micro and tiny: 8 and 16), then twice the last for each
            of any coarser levels, see :class:`network.CoarserLevels`.
        sizes: per level, side of the square of an anchor's area, in pixels of an image whose shorter side is
            ``reference``; they scale with the image's.
        reference: that side in pixels; None: sizes are pixels of any image, as in torchvision.
        ratios: of every anchor, height / width.
        foreground_iou, background_iou: overlaps from which an anchor is foreground, below which background.
    """

    strides: Sequence[int] = (8, 16)
    sizes: Sequence[Sequence[float]] = ((22, 28, 36), (46, 58, 74))
    reference: float | None = 96
    ratios: Sequence[float] = (1.0,)
    foreground_iou: float = 0.5
    background_iou: float = 0.4

    def __post_init__(self) -> None:
        counts, low = [len(level) for level in self.sizes], self.background_iou
        check(
            "detector.anchors",
            reference=(self.reference, self.reference is None or self.reference > 0, "above 0, or null"),
            sizes=(
                self.sizes,
                len(counts) == len(self.strides) and len(set(counts)) == 1,
                "one list for each stride, all of them equally long",
            ),
            foreground_iou=(self.foreground_iou, low <= self.foreground_iou <= 1, "background_iou up to 1"),
        )


@dataclass(frozen=True)
class Points:
    """The points of an FCOS, and which of them should find which object.

    Args:
        strides: of the pyramid's levels, as of :class:`Anchors`; a level has a point in every stride.
        limits: of all levels but the last, the largest distance from a point to a side of its box, in pixels of an
            image whose shorter side is ``reference``; larger ones are for the next level.
        reference: that side in pixels; None: limits are pixels of any image.
        radius: distance in strides, along each axis, within which a point may be of its box's centre.
    """

    strides: Sequence[int] = (8, 16)
    limits: Sequence[float] = (28,)
    reference: float | None = 96
    radius: float = 1.5

    def __post_init__(self) -> None:
        limits = list(self.limits)
        check(
            "detector.points",
            reference=(self.reference, self.reference is None or self.reference > 0, "above 0, or null"),
            limits=(
                limits,
                len(limits) == len(self.strides) - 1
                and limits == sorted(set(limits))
                and min([1.0, *limits]) > 0,
                "ascending, above 0, one for each stride but the last",
            ),
            radius=(self.radius, self.radius > 0, "above 0"),
        )

    def ranges(self, shorter_side: float) -> list[tuple[float, float]]:
        """Each level's distances to the farthest side, in pixels of an image of this size."""
        scale = 1.0 if self.reference is None else shorter_side / self.reference
        bounds = [0.0, *(scale * limit for limit in self.limits), float("inf")]
        return list(itertools.pairwise(bounds))


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
    box_delta: float = 0.1
    focal_alpha: float = 0.25
    focal_gamma: float = 2.0

    def __post_init__(self) -> None:
        check(
            "detector.losses",
            box=(self.box, self.box in get_args(BoxLoss), f"one of {get_args(BoxLoss)}"),
            box_delta=(self.box_delta, self.box_delta > 0, "above 0"),
        )


@dataclass(frozen=True)
class Detections:
    """Which predictions are detections: per level, the ``candidates`` best scores above ``score_threshold``; then
    non-maximum suppression within each class at ``nms_iou``, and the best ``limit`` are kept.
    """

    score_threshold: float = 0.05
    nms_iou: float = 0.5
    limit: int = 100
    candidates: int = 1000


def check(where: str, **conditions: tuple[object, bool, str]) -> None:
    """Raises ``ValueError`` for the first key of (got, holds, wanted) that does not hold."""
    for key, (got, holds, wanted) in conditions.items():
        if not holds:
            raise ValueError(f"{where}.{key}: want {wanted}, got {got!r}")
