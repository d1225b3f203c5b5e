"""Photographs of one size, each with its boxes, as one labelled set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class Photo:
    """A letterboxed photograph; ``bins`` are the pose bins of its boxes, None where nothing says them."""

    image: Float[Tensor, "3 height width"]
    boxes: Float[Tensor, "b 4"]
    labels: Int[Tensor, "b"]
    bins: Int[Tensor, "b"] | None = None


def assemble(photos: Sequence[Photo]) -> LabelledImages:
    """All photographs, boxes padded to the longest list among them; bins by box where some photograph has any.

    Raises ``ValueError`` for none.
    """
    if not photos:
        raise ValueError("target: want at least one photograph, got none")
    most = max(1, *(len(photo.boxes) for photo in photos))
    boxes = torch.zeros(len(photos), most, 4)
    labels, bins = (torch.full((len(photos), most), -1) for _ in range(2))
    for row, photo in enumerate(photos):
        count = len(photo.boxes)
        boxes[row, :count], labels[row, :count] = photo.boxes, photo.labels
        bins[row, :count] = -1 if photo.bins is None else photo.bins
    by_box = any(photo.bins is not None for photo in photos)
    images = torch.stack([photo.image for photo in photos])
    return LabelledImages(images, boxes, labels, bins if by_box else torch.full((len(photos),), -1))


def large_enough(boxes: Float[Tensor, "b 4"], minimum_side: float) -> Tensor:
    """Which boxes have both sides of at least so many pixels."""
    return ((boxes[:, 2:] - boxes[:, :2]) >= minimum_side).all(-1)


def boxes_by_bin(images: LabelledImages, names: Sequence[str]) -> str:
    """How many boxes of each object are in each bin, for the log."""
    counts = [Counter((images.bins[images.labels == label] + 1).tolist()) for label in range(len(names))]
    return "; ".join(
        f"{name} " + ", ".join(f"{b or 'unknown'}: {count}" for b, count in sorted(own.items()))
        for name, own in zip(names, counts, strict=True) if own
    )  # fmt: skip
