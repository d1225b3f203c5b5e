"""From rendered maps to labelled images; all randomness is drawn first, so that every pass can be replayed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from annotated_types import Ge, Lt
from jaxtyping import Bool, Float, Int
from torch import Tensor

from neural_sim.ranges import Ascending, Fraction, NonNegative, NonNegativeInt, PositiveInt, validated
from neural_sim.synthesis.background import Background
from neural_sim.synthesis.compositing import (
    apply_shift,
    boxes_from_opacity,
    by_depth,
    composite,
    draw_shift,
    stacked,
    visible_boxes,
)
from neural_sim.synthesis.distractors import Cover, Distractors
from neural_sim.synthesis.layout import Layout, ObjectCount
from neural_sim.synthesis.sensor import Sensor, SensorDraw, seen_by
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Nuisance:
    """What varies between images and is never learned.

    ``shifts`` are (right, down) in pixels, on the CPU, one for each object in an image; ``sensor`` is the camera's blur
    and noise (None: nothing); ``front`` is what hides the objects (None: nothing).
    """

    backgrounds: Float[Tensor, "n 3 h w"]
    shifts: Int[Tensor, "n *objects 2"]
    sensor: SensorDraw | None = None
    front: Cover | None = None

    def __len__(self) -> int:
        return self.backgrounds.shape[0]

    def select(self, index: Tensor | slice) -> Nuisance:
        """Return the nuisance of some images."""
        sensor = None if self.sensor is None else self.sensor.select(index)
        front = None if self.front is None else self.front.select(index)
        return Nuisance(self.backgrounds[index], self.shifts[index], sensor, front)


@validated
@dataclass(frozen=True)
class Synthesizer:
    """How a rendered object becomes a labelled training image.

    Args:
        background: source of backgrounds.
        shift: largest shift within the image, as a fraction of the image's width and height.
        threshold: opacity above which a pixel belongs to the object; exports use 0.5, where depth is measured.
        minimum_area: smallest number of visible pixels for which an object gets a box.
        objects_per_image: smallest and largest number of objects in an image, all of different classes; [0, 6] includes
            images without objects.
        min_visibility: smallest fraction of an object's pixels within the image that must not be hidden for it to get a
            box.
        sensor: blur and noise of the camera.
        distractors: unlabelled cut-outs, behind and in front of the objects.

    Raises:
        ValueError: the background has no method ``draw``.
    """

    background: Background
    shift: Fraction = 0.15
    threshold: Annotated[float, Ge(0), Lt(1)] = 0.5
    minimum_area: NonNegative = 16.0
    objects_per_image: Annotated[tuple[NonNegativeInt, PositiveInt], Ascending()] = (1, 1)
    min_visibility: Fraction = 0.1
    sensor: Sensor = field(default_factory=Sensor)
    distractors: Distractors = field(default_factory=Distractors)

    def __post_init__(self) -> None:
        if not hasattr(self.background, "draw"):
            raise ValueError(
                f"Synthesizer.background: want something with a draw method, got {self.background!r}"
            )

    @property
    def count(self) -> ObjectCount:
        """The number of objects in an image."""
        return ObjectCount(*self.objects_per_image)

    @property
    def several(self) -> bool:
        """Whether an image may have a number of objects other than one."""
        return self.count != ObjectCount(1, 1)

    def draw_nuisance(
        self,
        n: int,
        camera: PinholeCamera,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
        objects: int | None = None,
    ) -> Nuisance:
        """Draw what varies between n images, independently of the scene parameters.

        Args:
            n: number of images.
            camera: their camera.
            generator: source of randomness.
            device: device of backgrounds and covers.
            objects: number of shifts in each image; None: one, without an axis for objects.
        """
        height, width = camera.height, camera.width
        backgrounds = self.background.draw(n, height, width, generator, device)
        shifts = draw_shift(n * (objects or 1), self.shift, height, width, generator)
        sensor = self.sensor.draw(n, height, width, generator, device)
        front, covers = None, self.distractors.draw(n, height, width, generator, device)
        if covers is not None:
            backgrounds, front = covers[0].over(backgrounds), covers[1] if self.distractors.hide else None
        return Nuisance(backgrounds, shifts if objects is None else shifts.view(n, objects, 2), sensor, front)

    def compose(
        self,
        rgb: Float[Tensor, "n h w 3"],
        opacity: Float[Tensor, "n h w"],
        nuisance: Nuisance,
        label: int,
        bins: Int[Tensor, "n"],
    ) -> LabelledImages:
        """Compose one object's images with their boxes, on the device and in the dtype of ``rgb``.

        A pure function; the images are differentiable in ``rgb`` (premultiplied) and ``opacity``, the boxes are not. If
        too little of the object is in the frame and visible, the image has no box.
        """
        rgb, opacity = apply_shift(rgb, nuisance.shifts), apply_shift(opacity, nuisance.shifts)
        images = composite(rgb, opacity, nuisance.backgrounds.to(rgb))
        if nuisance.front is None:
            boxes, present = boxes_from_opacity(opacity, self.threshold, self.minimum_area)
        else:
            images, alone = nuisance.front.over(images), opacity.detach()[:, None]
            boxes, visible = self._boxes(alone, alone * _clear(nuisance.front, alone))
            present = visible[:, 0]
        images = seen_by(images, nuisance.sensor)
        labels = torch.where(present, label, -1)[:, None]
        labelled = LabelledImages(images, boxes, labels, bins.to(rgb.device))
        if _log.isEnabledFor(logging.DEBUG):  # counting waits for the device
            missing = images_without_boxes(labelled)
            _log.debug("class %d: %d of %d images without a box", label, missing, len(labelled))
        return labelled

    def compose_several(
        self,
        rgb: Float[Tensor, "n layers h w 3"],
        opacity: Float[Tensor, "n layers h w"],
        distance: Float[Tensor, "n layers"],
        layout: Layout,
        nuisance: Nuisance,
        bins: Int[Tensor, "n"],
    ) -> LabelledImages:
        """Compose images of several objects, a layer for each column of ``layout``, with boxes of what is visible.

        Layers without an object are zeros. A pure function, differentiable in ``rgb`` (premultiplied) and ``opacity``;
        the boxes are not differentiable.
        """
        shifts = nuisance.shifts.flatten(0, 1)
        rgb = apply_shift(rgb.flatten(0, 1), shifts).view(rgb.shape)
        opacity = apply_shift(opacity.flatten(0, 1), shifts).view(opacity.shape)
        nearest = by_depth(distance, layout.order).to(rgb.device)
        place = nearest[..., None, None].expand_as(opacity)
        rgb, opacity = rgb.gather(1, place[..., None].expand_as(rgb)), opacity.gather(1, place)
        labels = layout.labels.to(rgb.device).gather(1, nearest)
        images, visible = stacked(rgb, opacity, nuisance.backgrounds.to(rgb))
        if nuisance.front is not None:
            images, visible = nuisance.front.over(images), visible * _clear(nuisance.front, visible)
        boxes, present = self._boxes(opacity.detach(), visible.detach())
        labels = torch.where(present & (labels >= 0), labels, -1)
        return LabelledImages(seen_by(images, nuisance.sensor), boxes, labels, bins.to(rgb.device))

    def _boxes(
        self, opacity: Float[Tensor, "n layers h w"], visible: Float[Tensor, "n layers h w"]
    ) -> tuple[Float[Tensor, "n layers 4"], Bool[Tensor, "n layers"]]:
        return visible_boxes(opacity, visible, self.threshold, self.minimum_area, self.min_visibility)


def _clear(front: Cover, like: Tensor) -> Float[Tensor, "n 1 h w"]:
    """Return the fraction of what lies behind a cover that stays visible, by pixel."""
    return (1.0 - front.opacity.to(like))[:, None]


def unshown(images: LabelledImages, names: Sequence[str]) -> list[str]:
    """Return the classes that have no box in any image."""
    shown = set(images.labels[images.present].tolist())
    return [name for label, name in enumerate(names) if label not in shown]


def images_without_boxes(images: LabelledImages) -> int:
    """Count the images without any box."""
    return int((~images.present.any(-1)).sum())
