"""samples.html, which shows some images of an exported data set with their labels, and counts its content."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ImageDraw

from neural_sim.documents import write_whole
from neural_sim.pictures import read_picture
from neural_sim.report.figures import CLASS_COLOURS
from neural_sim.report.page import render
from neural_sim.report.page.pictures import Picture, jpeg
from neural_sim.synthesis.export.masks import mask_of, outlines

FILE = "samples.html"
SHOWN = 24
"""Number of images on the page."""
SIDE = 400
"""Longer side of an image in pixels."""

Record = Mapping[str, Any]
"""The record of an image, see ``synthesis.export.folder.record_of``."""


@dataclass(frozen=True)
class Labels:
    """The labels of a class.

    Args:
        name: name of the class.
        count: number of its labelled objects.
        hidden: number of its objects of which too little is visible for a label.
        sides: quartiles of the square roots of its boxes' areas in pixels; empty without boxes.
    """

    name: str
    count: int
    hidden: int
    sides: tuple[float, ...]

    @staticmethod
    def of(name: str, items: Sequence[Mapping[str, Any]]) -> Labels:
        """Count the objects of a class."""
        boxes = [item["box_visible"] for item in items if item["labelled"]]
        sides = [(width * height) ** 0.5 for _, _, width, height in boxes]
        quartiles = statistics.quantiles(sides, n=4, method="inclusive") if len(sides) > 1 else sides
        return Labels(name, len(boxes), len(items) - len(boxes), tuple(quartiles))


def write_samples_page(
    root: Path, records: Sequence[Record], names: Sequence[str], parts: Mapping[str, Sequence[Record]]
) -> Path:
    """Write samples.html into a data set's folder.

    Args:
        root: the folder.
        records: records of all its images.
        names: names of the classes.
        parts: records of each part; empty if there is no split.
    """
    items = [item for record in records for item in record["objects"]]
    by_class = [
        Labels.of(name, [i for i in items if i["label"] == label]) for label, name in enumerate(names)
    ]
    chosen = np.linspace(0, len(records) - 1, min(SHOWN, len(records))).round().astype(int).tolist()
    text = render.page(
        "samples.html",
        title="Images drawn by Neural-Sim",
        count=len(records),
        parts={name: len(own) for name, own in parts.items()},
        empty=sum(not any(item["labelled"] for item in record["objects"]) for record in records),
        classes=by_class,
        pictures=[_labelled(root, records[number], names) for number in chosen],
    )
    return write_whole(root / FILE, text)


def _labelled(root: Path, record: Record, names: Sequence[str]) -> Picture:
    """Return an image with its boxes and the outlines of its visible masks."""
    image = read_picture(root / record["file"], upright=False).convert("RGB")
    scale = SIDE / max(image.size)
    image = image.resize((round(scale * image.width), round(scale * image.height)))
    pen, shown = ImageDraw.Draw(image), [item for item in record["objects"] if item["labelled"]]
    for item in shown:
        colour = CLASS_COLOURS[item["label"] % len(CLASS_COLOURS)]
        x, y, width, height = (scale * side for side in item["box_visible"])
        for loop in outlines(mask_of(item["mask_visible"])):
            pen.polygon((scale * loop).flatten().tolist(), outline="white")
        pen.rectangle((x, y, x + width, y + height), outline=colour, width=2)
    said = ", ".join([names[int(item["label"])] for item in shown]) or "no object"
    return Picture(jpeg(image), f"{record['number']}: {said}")
