"""COCO files of drawn images: of a training set in memory, with its pictures, or of an exported set's records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from neural_sim.synthesis.export.folder import write_json
from neural_sim.types import LabelledImages

COCO = "annotations.json"


def write_coco(
    images: LabelledImages,
    class_names: Sequence[str],
    folder: str | Path,
    poses: Sequence[Sequence[Mapping[str, Any]]] | None = None,
) -> Path:
    """Write ``folder/images/*.png`` (8 bit) and ``folder/annotations.json``; return the latter's path.

    ``poses`` lists the poses of each image's objects, labelled or not: their ``category_id``, phi, rho (radians),
    distance (object radii), camera_to_world [4, 4] (OpenGL axes) and whatever else made the image. They are stored as
    the image's ``poses``, next to its ``bin``. The JSON is written last, whole or not at all: if it exists, so do all
    its images.

    Raises:
        ValueError: a label has no name, or the numbers of ``poses`` and images differ.
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
    path = folder / COCO
    write_json(path, document)
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
    """Make one annotation; COCO counts ids from 1 and gives boxes as x, y, width, height."""
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


def coco_document(
    records: Sequence[Mapping[str, Any]],
    class_names: Sequence[str],
    camera: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Assemble COCO's document of an exported set from its images' records, in the order of their numbers.

    ``bbox``, ``area`` and ``segmentation`` (compressed run lengths) describe what is visible. Annotations have further
    entries: ``bbox_full``, the box around the whole silhouette, also beyond the image; ``segmentation_full``, the
    silhouette within the image; ``visibility``, the visible fraction of the silhouette's pixels; ``pose``. Objects of
    which too little is visible have no annotation. ``camera`` is the camera of all images, if they share one.
    """
    entries, annotations = [], []
    for record in records:
        size = {key: record["camera"][key] for key in ("height", "width")}
        image = record["number"] + 1
        entries.append({"id": image, "file_name": record["file"], **size, "camera": record["camera"]})
        for item in record["objects"]:
            if item["labelled"]:
                annotations.append(_masked(len(annotations) + 1, image, item))
    return {
        "info": {"description": "images drawn by Neural-Sim", "version": "1.0"},
        "licenses": [],
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(class_names)],
        **({} if camera is None else {"camera": dict(camera)}),
        "images": entries,
        "annotations": annotations,
    }


def _masked(number: int, image: int, item: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": number,
        "image_id": image,
        "category_id": item["label"] + 1,
        "bbox": item["box_visible"],
        "area": item["pixels"]["visible"],
        "iscrowd": 0,
        "segmentation": item["mask_visible"],
        "bbox_full": item["box_full"],
        "segmentation_full": item["mask_full"],
        "visibility": item["visibility"],
        "pose": item["pose"],
    }
