"""A drawn set as COCO: PNG images and one JSON that also holds every image's pose."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from neural_sim.types import LabelledImages


def write_coco(
    images: LabelledImages,
    class_names: Sequence[str],
    folder: str | Path,
    poses: Sequence[Sequence[Mapping[str, Any]]] | None = None,
) -> Path:
    """Write ``folder/images/*.png`` (8 bit) and ``folder/annotations.json``, whose path is returned.

    ``poses`` are those of the objects in each image, labelled or hidden: their ``category_id``, phi, rho (radians),
    distance (object radii), camera_to_world [4, 4] (OpenGL axes) and whatever else made the image. They become each
    image's ``poses``, beside its ``bin``. The JSON comes last and at once, so that where it exists all its images do.

    Raises:
        ValueError: a label without a name, or poses of another number of images.
    """
    folder = Path(folder)
    _check(images, class_names, poses)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    pixels = images.images.detach().clamp(0.0, 1.0).mul(255.0).round().to(torch.uint8).movedim(1, -1).cpu()
    entries, annotations = [], []
    for row in range(len(images)):
        name = f"images/{row:06d}.png"
        Image.fromarray(pixels[row].numpy()).save(folder / name, compress_level=1)
        entry = {"id": row + 1, "file_name": name, "height": pixels.shape[1], "width": pixels.shape[2]}
        known = {} if poses is None else {"poses": [dict(pose) for pose in poses[row]]}
        entries.append({**entry, "bin": int(images.bins[row]), **known})
        for box, label in zip(images.boxes[row].tolist(), images.labels[row].tolist(), strict=True):
            if label >= 0:
                annotations.append(_annotation(len(annotations) + 1, row + 1, label, box))
    document = {
        "info": {"description": "images drawn by Neural-Sim", "version": "1.0"},
        "licenses": [],
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(class_names)],
        "images": entries,
        "annotations": annotations,
    }
    path = folder / "annotations.json"
    draft = path.with_suffix(".json.part")
    draft.write_text(json.dumps(document, allow_nan=False), encoding="utf-8")
    os.replace(draft, path)
    return path


def _check(
    images: LabelledImages, class_names: Sequence[str], poses: Sequence[Sequence[Mapping[str, Any]]] | None
) -> None:
    if images.labels.numel() and int(images.labels.max()) >= len(class_names):
        raise ValueError(
            f"write_coco: label {int(images.labels.max())} has no name among {list(class_names)}"
        )
    if poses is not None and len(poses) != len(images):
        raise ValueError(f"write_coco: poses has {len(poses)} rows for {len(images)} images")


def _annotation(number: int, image: int, label: int, box: Sequence[float]) -> dict[str, Any]:
    """COCO counts ids from 1 and gives boxes as x, y, width, height."""
    x0, y0, x1, y1 = box
    return {
        "id": number,
        "image_id": image,
        "category_id": label + 1,
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "area": (x1 - x0) * (y1 - y0),
        "iscrowd": 0,
        "segmentation": [],
    }
