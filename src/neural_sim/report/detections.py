"""Detections in files: COCO rows, ``detections.json``, pictures and a table of scores; and the final training set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.detector.metrics import AveragePrecision, TestScore
from neural_sim.documents import read_json, write_json
from neural_sim.report.figures import CLASS_COLOURS
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.target.truth import without_pixels
from neural_sim.types import LabelledImages

DETECTIONS = "detections.json"

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
    return write_json(folder / DETECTIONS, {"images": len(test), **rows}, indent=None)


def read_detections(file: Path) -> tuple[LabelledImages, dict[str, list[Detections]]]:
    """Read detections.json: the test set without pixels, and the detections of every detector.

    Raises:
        ValueError: the file is not JSON or holds something else; the message has its path.
    """
    stored = read_json(file)
    try:
        count = stored.pop("images")
        by_image = {which: _by_image(rows, count) for which, rows in stored.items()}
        truth = by_image.pop("truth")
        if not truth:
            raise ValueError("no images")
        return without_pixels([(image["boxes"], image["labels"]) for image in truth]), by_image
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{file}: want the images, truth and detections of a run ({error!r})") from error


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


WRITABLE = (".png", ".jpg", ".jpeg", ".bmp", ".webp")


def draw(
    photo: Image.Image,
    found: Detections,
    class_names: Sequence[str],
    above: float,
    truth: Tensor | None = None,
) -> Image.Image:
    """Draw detections on a copy of an RGB photograph, the best on top, each with its class and score.

    Args:
        photo: the photograph.
        found: its detections.
        class_names: names of the classes, by label.
        above: smallest score that is drawn.
        truth: true boxes, (x0, y0, x1, y1) in pixels, drawn thin and white.
    """
    drawn = photo.copy()
    pen, side = ImageDraw.Draw(drawn), max(photo.size)
    for box in [] if truth is None else truth.tolist():
        pen.rectangle(box, outline="white", width=max(1, side // 600))
    font, thick = ImageFont.load_default(size=max(10, side / 45)), max(2, side // 300)
    rows = zip(*(found[key].tolist() for key in ("scores", "labels", "boxes")), strict=True)
    for score, label, box in sorted((row for row in rows if row[0] >= above), key=lambda row: row[0]):
        colour = CLASS_COLOURS[label % len(CLASS_COLOURS)]
        pen.rectangle(box, outline=colour, width=thick)
        caption = f" {class_names[label]} {score:.2f} "
        _, _, wide, high = pen.textbbox((0, 0), caption, font=font)
        # Captions go above the box, or inside it if there is no room, and never past the picture's right edge.
        left = max(0, min(box[0], photo.width - wide))
        top = box[1] - high - 2 if box[1] >= high + 2 else box[1]
        pen.rectangle((left, top, left + wide, top + high + 2), fill=colour)
        pen.text((left, top), caption, fill="white", font=font)
    return drawn


def save_picture(picture: Image.Image, folder: Path, name: str) -> Path:
    """Write a picture under its photograph's name, as PNG if PIL does not write the photograph's format well."""
    path = folder / name
    if path.suffix.lower() not in WRITABLE:
        path = path.with_name(f"{path.name}.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in (".jpg", ".jpeg", ".webp"):
        picture.save(path, quality=92)
    else:
        picture.save(path)
    return path


def scores_table(scores: TestScore, images: int) -> str:
    """Return the printed table of scores by class, in percent."""
    if isinstance(scores, AveragePrecision):
        name, columns = "AP", {"AP": scores.per_class, "AP50": scores.per_class_ap50}
        means = [scores.ap, scores.ap50]
    else:
        name, columns, means = "accuracy", {"accuracy": scores.per_class}, [scores.accuracy]
    lines = [f"{f'{name} on {images} pictures':<28}" + "".join(f"{column:>8}" for column in columns)]
    rows = [(of, [column[of] for column in columns.values()]) for of in scores.per_class]
    for of, row in [*rows, ("mean", means)]:
        lines.append(f"{of[:27]:<28}" + "".join(f"{100 * value:>8.1f}" for value in row))
    return "\n".join(lines)
