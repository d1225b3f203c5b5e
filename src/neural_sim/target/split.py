"""Validation and test parts of one labelled set."""

from __future__ import annotations

import hashlib

import torch

from neural_sim.types import LabelledImages


def split(
    images: LabelledImages, fraction: float, generator: torch.Generator
) -> tuple[LabelledImages, LabelledImages]:
    """A random ``fraction`` of the images for validation and the rest for test: disjoint, neither empty.

    Images of equal pixels, such as a photograph that is listed twice, go to the same part, which may make validation
    larger than its fraction. Raises ``ValueError`` where one part would be empty.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"target: the validation fraction must lie in (0, 1), got {fraction}")
    different = _equal(images)
    wanted = round(fraction * len(images))
    parts: tuple[list[int], list[int]] = ([], [])
    for place in torch.randperm(len(different), generator=generator).tolist():
        parts[len(parts[0]) >= wanted].extend(different[place])
    if not all(parts):
        raise ValueError(
            f"target: {fraction} of {len(images)} images, {len(different)} of them different, leaves validation or "
            "test empty; give more images"
        )
    val, test = (images.select(torch.tensor(part, device=images.images.device)) for part in parts)
    return val, test


def _equal(images: LabelledImages) -> list[list[int]]:
    """Indices of the images, those of equal pixels together, in the order of the first of each."""
    groups: dict[bytes, list[int]] = {}
    for index, image in enumerate(images.images.cpu()):
        groups.setdefault(hashlib.sha256(image.numpy().tobytes()).digest(), []).append(index)
    return list(groups.values())
