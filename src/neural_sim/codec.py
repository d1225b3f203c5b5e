"""Stage results as plain tensors and numbers, images in 8 bits, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neural_sim.types import LabelledImages, PinholeCamera, PosedViews


def _to_bytes(images: Tensor) -> Tensor:
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def _to_floats(images: Tensor) -> Tensor:
    return images.to(torch.float32) / 255


def pack_views(views: PosedViews) -> dict[str, Any]:
    """Views with RGBA in 8 bits."""
    camera, weights = views.camera, views.light_weights
    return {
        "images": _to_bytes(views.images),
        "camera_to_world": views.camera_to_world.cpu(),
        "camera": [camera.width, camera.height, camera.field_of_view],
        "light_weights": None if weights is None else weights.cpu(),
    }


def unpack_views(held: Mapping[str, Any]) -> PosedViews:
    """Inverse of :func:`pack_views` up to the 8 bits."""
    width, height, field_of_view = held["camera"]
    camera = PinholeCamera(int(width), int(height), float(field_of_view))
    return PosedViews(_to_floats(held["images"]), held["camera_to_world"], camera, held["light_weights"])


def pack_images(images: LabelledImages) -> dict[str, Tensor]:
    """Labelled images in 8 bits."""
    return {
        "images": _to_bytes(images.images),
        "boxes": images.boxes.cpu(),
        "labels": images.labels.cpu(),
        "bins": images.bins.cpu(),
    }


def unpack_images(held: Mapping[str, Tensor]) -> LabelledImages:
    """Inverse of :func:`pack_images` up to the 8 bits."""
    return LabelledImages(_to_floats(held["images"]), held["boxes"], held["labels"], held["bins"])
