"""Validation and test parts of one labelled set."""

from __future__ import annotations

import torch

from neural_sim.types import LabelledImages


def split(
    images: LabelledImages, fraction: float, generator: torch.Generator
) -> tuple[LabelledImages, LabelledImages]:
    """A random ``fraction`` of the images for validation and the rest for test: disjoint, neither empty.

    Raises ``ValueError`` where one of them would be empty.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"target: the validation fraction must lie in (0, 1), got {fraction}")
    count = round(fraction * len(images))
    if not 0 < count < len(images):
        raise ValueError(
            f"target: {fraction} of {len(images)} images leaves validation or test empty; give more images"
        )
    order = torch.randperm(len(images), generator=generator).to(images.images.device)
    return images.select(order[:count]), images.select(order[count:])
