"""YOLO's text labels: boxes next to the images, and polygons in another folder, as a YOLO set has one or the other.

See https://docs.ultralytics.com/datasets/detect and /segment: each line is an object, with its class and with numbers
in units of the image's width and height.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neural_sim.synthesis.export.folder import same_file, write_whole
from neural_sim.synthesis.export.masks import mask_of, polygon

DATA = "dataset.yaml"
SEGMENT = "segment"


def write_yolo(
    folder: Path,
    records: Sequence[Mapping[str, Any]],
    class_names: Sequence[str],
    parts: Mapping[str, Sequence[Mapping[str, Any]]],
) -> None:
    """Write ``dataset.yaml``, its lists of images, and ``labels/*.txt`` (boxes) for ``folder/images``.

    ``segment`` has the same images, with the visible masks as polygons. Images without objects have empty files, as
    YOLO expects.

    Args:
        folder: the data set's folder.
        records: records of all images.
        class_names: names of the classes, by label.
        parts: records of ``train`` and ``val``; if empty, both are all images, and the file says so.
    """
    for record in records:
        name = Path(record["file"])
        for place, line in ((folder, box_line), (folder / SEGMENT, polygon_line)):
            lines = [line(item, record["camera"]) for item in record["objects"] if item["labelled"]]
            path = place / "labels" / f"{name.stem}.txt"
            if not path.is_file():
                write_whole(path, "".join(f"{text}\n" for text in lines))
        same_file(folder / name, folder / SEGMENT / "images" / name.name)
    names = "".join(f"  {label}: {_quoted(name)}\n" for label, name in enumerate(class_names))
    # The file names no root, so readers take its paths as relative to itself.
    heads = [f"{part}: {part}.txt\n" for part in parts] or [
        "train: images\nval: images # no split is made; name your own\n"
    ]
    text = f"{''.join(heads)}nc: {len(class_names)}\nnames:\n{names}"
    for place in (folder, folder / SEGMENT):
        for part, own in parts.items():
            write_whole(place / f"{part}.txt", "".join(f"./{record['file']}\n" for record in own))
        write_whole(place / DATA, text)


def _quoted(text: str) -> str:
    """Quote a text for YAML, which has JSON's escapes except those of characters beyond 16 bits."""
    quoted = (json.dumps(letter)[1:-1] if ord(letter) < 0x10000 else letter for letter in text)
    return f'"{"".join(quoted)}"'


def box_line(item: Mapping[str, Any], size: Mapping[str, float]) -> str:
    """Write an object's class, and the centre and size of its visible box."""
    x, y, width, height = item["box_visible"]
    numbers = (x + 0.5 * width) / size["width"], (y + 0.5 * height) / size["height"]
    sides = width / size["width"], height / size["height"]
    return " ".join([str(item["label"]), *(f"{value:.9f}" for value in (*numbers, *sides))])


def polygon_line(item: Mapping[str, Any], size: Mapping[str, float]) -> str:
    """Write an object's class, and a polygon along the pixel edges of its visible mask, see ``masks.polygon``."""
    corners = polygon(mask_of(item["mask_visible"])) / (size["width"], size["height"])
    return " ".join([str(item["label"]), *(f"{value:.9f}" for value in corners.flatten().tolist())])
