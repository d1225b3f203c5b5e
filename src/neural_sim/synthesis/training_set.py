"""Rendered maps to labelled images; all randomness is drawn first, so that every pass can be replayed."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.synthesis.background import Background
from neural_sim.synthesis.boxes import boxes_from_opacity
from neural_sim.synthesis.compositing import apply_shift, composite, draw_shift
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Nuisance:
    """What varies between images and is never learned. ``shifts`` are (right, down) in pixels, on the CPU."""

    backgrounds: Float[Tensor, "n 3 h w"]
    shifts: Int[Tensor, "n 2"]

    def __len__(self) -> int:
        return self.backgrounds.shape[0]

    def select(self, index: Tensor | slice) -> Nuisance:
        return Nuisance(self.backgrounds[index], self.shifts[index])


@dataclass(frozen=True)
class Synthesizer:
    """How a rendered object becomes a labelled training image.

    Args:
        background: where backgrounds come from.
        shift: largest in-image shift, as a fraction of the image's width and height.
        threshold: opacity above which a pixel belongs to the object.
        minimum_area: fewest pixels of an object that get a box; below, the image has none.
        label_gradient: ``ignored`` is the paper's; ``differentiable`` lets boxes carry the derivative of their
            edges, so that the pathwise gradient sees that regression targets move with the object.

    Raises:
        ValueError: a fraction outside [0, 1], a threshold outside [0, 1), a negative area, another label_gradient.
    """

    background: Background
    shift: float = 0.15
    threshold: float = 0.5
    minimum_area: float = 16.0
    label_gradient: Literal["ignored", "differentiable"] = "ignored"

    def __post_init__(self) -> None:
        if not hasattr(self.background, "draw"):
            raise ValueError(f"synthesis.background must have a draw method, got {self.background!r}")
        if not 0.0 <= self.shift <= 1.0:
            raise ValueError(f"synthesis.shift must lie in [0, 1], got {self.shift}")
        if not 0.0 <= self.threshold < 1.0:
            raise ValueError(f"synthesis.threshold must lie in [0, 1), got {self.threshold}")
        if not self.minimum_area >= 0.0:
            raise ValueError(f"synthesis.minimum_area must not be negative, got {self.minimum_area}")
        if self.label_gradient not in ("ignored", "differentiable"):
            raise ValueError(
                f"synthesis.label_gradient must be ignored or differentiable, got {self.label_gradient!r}"
            )

    def draw_nuisance(
        self, n: int, camera: PinholeCamera, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> Nuisance:
        """Backgrounds, on ``device``, and shifts of n images; independent of the scene parameters."""
        backgrounds = self.background.draw(n, camera.height, camera.width, generator, device)
        return Nuisance(backgrounds, draw_shift(n, self.shift, camera.height, camera.width, generator))

    def compose(
        self,
        rgb: Float[Tensor, "n h w 3"],
        opacity: Float[Tensor, "n h w"],
        nuisance: Nuisance,
        label: int,
        bins: Int[Tensor, "n"],
    ) -> LabelledImages:
        """One object's images with their boxes, on the device and in the dtype of ``rgb``.

        A pure function; the images are differentiable in ``rgb`` (premultiplied) and ``opacity``, the boxes in
        ``opacity`` if ``label_gradient`` says so. An object that is out of frame or below ``minimum_area`` gives
        an image without a box.
        """
        rgb, opacity = apply_shift(rgb, nuisance.shifts), apply_shift(opacity, nuisance.shifts)
        images = composite(rgb, opacity, nuisance.backgrounds.to(rgb))
        moving = self.label_gradient == "differentiable"
        boxes, present = boxes_from_opacity(opacity, self.threshold, self.minimum_area, moving)
        labels = torch.where(present, label, -1)[:, None]
        labelled = LabelledImages(images, boxes, labels, bins.to(rgb.device))
        if _log.isEnabledFor(logging.DEBUG):  # counting makes the host wait for the device
            missing = images_without_boxes(labelled)
            _log.debug("class %d: %d of %d images without a box", label, missing, len(labelled))
        return labelled


def images_without_boxes(images: LabelledImages) -> int:
    """How many images hold no box at all."""
    return int((~images.present.any(-1)).sum())
