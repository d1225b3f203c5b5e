"""COCO files of a run: result rows, ``detections.json`` with the test set's boxes, and the final training set."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.documents import write_json
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.types import LabelledImages

FILE = "detections.json"

Detections = Mapping[str, Tensor]
"""One image's ``boxes`` (x0, y0, x1, y1) in pixels, ``labels`` from 0 and ``scores``."""


def result_rows(
    found: Detections, image_id: Any, category_ids: Mapping[int, Any] | None = None, rounded: bool = False
) -> list[dict[str, Any]]:
    """Return COCO's result rows of one image, bbox as (x, y, width, height) in pixels.

    Args:
        found: the detections; boxes without scores get the score 1.
        image_id: the image's id.
        category_ids: ids by label; a class without an id gets no rows. None: the label plus 1.
        rounded: round boxes to 0.001 pixels and scores to five digits; otherwise the rows keep every digit.
    """
    scores = found.get("scores", torch.ones(len(found["labels"])))
    rows = []
    for box, label, score in zip(
        found["boxes"].tolist(), found["labels"].tolist(), scores.tolist(), strict=True
    ):
        if category_ids is not None and label not in category_ids:
            continue
        category = label + 1 if category_ids is None else category_ids[label]
        if rounded:
            box, score = [round(side, 3) for side in box], round(score, 5)
        x0, y0, x1, y1 = box
        bbox = [x0, y0, x1 - x0, y1 - y0]
        rows.append({"image_id": image_id, "category_id": category, "bbox": bbox, "score": score})
    return rows


def write_detections(
    test: LabelledImages, detections: Mapping[str, Sequence[Detections]], folder: Path
) -> Path:
    """Write detections.json: the test set's boxes (``truth``) and every detector's detections, by image from 0."""
    truth = [
        {"boxes": boxes[own], "labels": labels[own]}
        for boxes, labels, own in zip(test.boxes, test.labels, test.present, strict=True)
    ]
    rows = {
        which: [row for index, image in enumerate(images) for row in result_rows(image, index, rounded=True)]
        for which, images in {"truth": truth, **detections}.items()
    }
    return write_json(folder / FILE, {"images": len(test), **rows}, indent=None)


def read_detections(file: Path) -> tuple[LabelledImages, dict[str, list[Detections]]]:
    """Read detections.json: the test set without pixels, and the detections of every detector."""
    stored = json.loads(file.read_text(encoding="utf-8"))
    count = stored.pop("images")
    by_image = {which: _by_image(rows, count) for which, rows in stored.items()}
    truth = by_image.pop("truth")
    most = max(len(image["labels"]) for image in truth)
    boxes, labels = torch.zeros(count, most, 4), torch.full((count, most), -1)
    for index, image in enumerate(truth):
        boxes[index, : len(image["labels"])] = image["boxes"]
        labels[index, : len(image["labels"])] = image["labels"]
    bins = torch.zeros(count, dtype=torch.long)
    return LabelledImages(torch.zeros(count, 3, 1, 1), boxes, labels, bins), by_image


def _by_image(rows: Sequence[Mapping[str, Any]], count: int) -> list[Detections]:
    grouped: list[list[Mapping[str, Any]]] = [[] for _ in range(count)]
    for row in rows:
        grouped[row["image_id"]].append(row)
    detections = []
    for group in grouped:
        boxes = torch.tensor([row["bbox"] for row in group]).reshape(-1, 4)
        corners = torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], -1)
        labels = torch.tensor([row["category_id"] - 1 for row in group], dtype=torch.long)
        scores = torch.tensor([row["score"] for row in group])
        detections.append({"boxes": corners, "labels": labels, "scores": scores})
    return detections


def write_training_set(rendered: RenderedImages, names: Sequence[str], folder: Path) -> Path:
    """Write the final training set as COCO: images, and a JSON file that includes the pose of every object."""
    poses: list[list[dict[str, Any]]] = [[] for _ in range(len(rendered))]
    for label, (part, rows) in enumerate(zip(rendered.objects, rendered.rows, strict=True)):
        draw, distance = part.draw, part.draw.distance / part.draw.radius  # object radii
        values = {name: getattr(draw, name) for name in ("phi", "rho", "magnification", "bins")}
        values |= {"distance": distance, "camera_to_world": orbit(draw.phi, draw.rho, distance)}
        listed = {key: value.tolist() for key, value in values.items() if value is not None}
        for place, row in enumerate(rows.tolist()):
            pose = {key: value[place] for key, value in listed.items()}
            poses[row].append({"category_id": label + 1, **pose})
    return write_coco(rendered.images, list(names), folder, poses)
