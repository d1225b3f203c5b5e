"""Photographs of any size through a detector of images of one size, and its boxes back in their pixels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from PIL import Image
from torch import Tensor

from neural_sim.detector.saved import SavedDetector
from neural_sim.target.photographs import letterbox


def detect(saved: SavedDetector, photos: Sequence[Image.Image]) -> list[dict[str, Tensor]]:
    """Detections of each photograph, best first, on the CPU: boxes [d, 4] as (x0, y0, x1, y1) in the photograph's
    pixels and within it, scores [d], labels [d].

    Photographs are letterboxed as those of a target set are. Detections that lie in the grey border alone are none.
    """
    if not photos:
        return []
    images, placings = zip(*(letterbox(photo, *saved.image_size) for photo in photos), strict=True)
    found = saved.detector.predict(saved.params, torch.stack(images))
    detections = []
    for placing, image in zip(placings, found, strict=True):
        boxes = placing.of_photo(image["boxes"])
        inside = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        detections.append({name: value[inside] for name, value in {**image, "boxes": boxes}.items()})
    return detections
