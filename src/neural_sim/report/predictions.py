"""Predictions on photographs: pictures with boxes, and a table of scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

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
    rows = {of: [column[of] for column in columns.values()] for of in scores.per_class} | {"mean": means}
    for of, row in rows.items():
        lines.append(f"{of[:27]:<28}" + "".join(f"{100 * value:>8.1f}" for value in row))
    return "\n".join(lines)
