"""Images with boxes, for the pages."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import UInt8
from PIL import Image, ImageDraw
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torchvision.ops import box_iou

from neural_sim.detector.protocol import Score
from neural_sim.report.figures import CLASS_COLOURS
from neural_sim.types import LabelledImages

SHORTEST = 192
"""Smallest shorter side of a picture in pixels; on smaller pictures, boxes would be coarse."""
OVERLAP = 0.5
"""Intersection over union from which a detection counts as right on the pages."""
SHOWN = 0.3
"""On images without objects, detections with at least this score are shown and count as wrong."""


@dataclass(frozen=True)
class Picture:
    """An image as the source of an ``<img>``, and the line below it."""

    source: str
    caption: str


def labelled(images: LabelledImages, rows: Sequence[int], names: Sequence[str]) -> list[Picture]:
    """Return images with their ground-truth boxes."""
    pictures = []
    for row in rows:
        own = images.labels[row] >= 0
        boxes, labels = images.boxes[row][own], images.labels[row][own]
        shown = [str(names[label]) for label in labels.tolist()]
        pictures.append(Picture(_drawn(images.images[row], boxes, labels), ", ".join(shown) or "no box"))
    return pictures


def detected(
    images: LabelledImages,
    rows: Sequence[int],
    detections: Sequence[Mapping[str, Tensor]],
    names: Sequence[str],
) -> list[Picture]:
    """Return images with their best detections over thin white ground-truth boxes.

    There are as many detections as objects; on an image without objects, those that score ``SHOWN`` or more.
    """
    pictures = []
    for row in rows:
        truth = images.boxes[row][images.labels[row] >= 0]
        best = _best(detections[row], len(truth))
        parts = zip(best["labels"].tolist(), best["scores"].tolist(), strict=True)
        caption = ", ".join(f"{names[label]} {score:.2f}" for label, score in parts) or "nothing"
        pictures.append(Picture(_drawn(images.images[row], best["boxes"], best["labels"], truth), caption))
    return pictures


def right(detections: Mapping[str, Tensor], boxes: Tensor, labels: Tensor, score: Score = "AP") -> bool:
    """Return whether an image's best detections, as many as it has objects, match these objects.

    Each must have the right class and an overlap of at least ``OVERLAP``; for accuracy, the right class is enough. An
    image without objects is right if no detection scores ``SHOWN`` or more.
    """
    best = _best(detections, len(boxes))
    if not len(boxes):
        return not len(best["scores"])
    if len(best["boxes"]) < len(boxes):
        return False
    same = best["labels"][:, None] == labels[None, :]
    if score == "AP":
        same &= box_iou(best["boxes"].float(), boxes.float()) >= OVERLAP
    hits = same.numpy()
    return bool(hits[linear_sum_assignment(hits, maximize=True)].all())


def _best(detections: Mapping[str, Tensor], objects: int) -> dict[str, Tensor]:
    order = detections["scores"].argsort(descending=True, stable=True)
    order = order[:objects] if objects else order[detections["scores"][order] >= SHOWN]
    return {key: detections[key][order] for key in ("boxes", "labels", "scores")}


def _drawn(image: Tensor, boxes: Tensor, labels: Tensor, truth: Tensor | None = None) -> str:
    pixels = image.detach().clamp(0, 1).mul(255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    large = Image.fromarray(pixels)
    scale = max(1, -(-SHORTEST // min(large.size)))
    large = large.resize((scale * large.width, scale * large.height), Image.Resampling.BICUBIC)
    pen = ImageDraw.Draw(large)
    for box in [] if truth is None else (scale * truth).tolist():
        pen.rectangle(box, outline="white", width=2)
    for box, label in zip((scale * boxes).tolist(), labels.tolist(), strict=True):
        pen.rectangle(box, outline=CLASS_COLOURS[label % len(CLASS_COLOURS)], width=3)
    return jpeg(large)


def picture(image: UInt8[Tensor, "h w c"]) -> str:
    """Return an image as the source of an ``<img>``."""
    pixels = image.numpy()
    return jpeg(Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels), quality=88)


def jpeg(image: Image.Image, quality: int = 85) -> str:
    """Return a picture as the source of an ``<img>``."""
    buffer = io.BytesIO()
    image.save(buffer, format="JPEG", quality=quality)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
