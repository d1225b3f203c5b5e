"""Predictions on photographs: pictures with boxes, and COCO's results."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from neural_sim.detector.metrics import AveragePrecision, TestScore
from neural_sim.report.figures import CLASS_COLOURS

WRITABLE = (".png", ".jpg", ".jpeg", ".bmp", ".webp")


def draw(
    photo: Image.Image,
    found: Mapping[str, Tensor],
    class_names: Sequence[str],
    above: float,
    truth: Tensor | None = None,
) -> Image.Image:
    """A copy of an RGB photograph with the boxes of detections that score ``above`` that or more, the best on top, each
    with its class and score; true boxes, (x0, y0, x1, y1) in pixels, are thin and white.
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
        # Above the box, inside it where there is no room, and never past the picture's right edge.
        left = max(0, min(box[0], photo.width - wide))
        top = box[1] - high - 2 if box[1] >= high + 2 else box[1]
        pen.rectangle((left, top, left + wide, top + high + 2), fill=colour)
        pen.text((left, top), caption, fill="white", font=font)
    return drawn


def save_picture(picture: Image.Image, folder: Path, name: str) -> Path:
    """Write a picture under its photograph's name, as PNG where PIL writes no files of that kind well."""
    path = folder / name
    if path.suffix.lower() not in WRITABLE:
        path = path.with_name(f"{path.name}.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in (".jpg", ".jpeg", ".webp"):
        picture.save(path, quality=92)
    else:
        picture.save(path)
    return path


def result_rows(
    found: Mapping[str, Tensor], image_id: Any, category_ids: Mapping[int, Any]
) -> list[dict[str, Any]]:
    """COCO's result rows of one image, bbox as (x, y, width, height) in pixels. Nothing is rounded, so that the rows
    score what the detections do. Classes without a category have no rows.
    """
    rows = zip(*(found[key].tolist() for key in ("boxes", "labels", "scores")), strict=True)
    return [
        {
            "image_id": image_id,
            "category_id": category_ids[label],
            "bbox": [x0, y0, x1 - x0, y1 - y0],
            "score": score,
        }
        for (x0, y0, x1, y1), label, score in rows
        if label in category_ids
    ]


def scores_document(scores: TestScore, images: int) -> dict[str, Any]:
    """The content of scores.json; classes without a true box are null."""
    return {"images": images, **_known(dataclasses.asdict(scores))}


def scores_table(scores: TestScore, images: int) -> str:
    """The score by class in percent, as it is printed."""
    if isinstance(scores, AveragePrecision):
        name, columns = "AP", {"AP": scores.per_class, "AP50": scores.per_class_ap50}
        means = [scores.ap, scores.ap50]
    else:
        name, columns, means = "accuracy", {"accuracy": scores.per_class}, [scores.accuracy]
    lines = [f"{f'{name} on {images} pictures':<28}" + "".join(f"{column:>8}" for column in columns)]
    rows = {of: [column[of] for column in columns.values()] for of in scores.per_class} | {"mean": means}
    for of, row in rows.items():
        lines.append(f"{of[:27]:<28}" + "".join(f"{100 * value:>8.1f}" for value in row))
    return "\n".join(lines)


def _known(tree: Any) -> Any:
    """NaN as None, so that the file is JSON by the standard."""
    if isinstance(tree, dict):
        return {key: _known(value) for key, value in tree.items()}
    return tree if tree == tree else None
