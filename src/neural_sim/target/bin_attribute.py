"""Pose bins that a COCO file says itself: an attribute of its annotations, or of their images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def bins_of(
    annotations: Sequence[Mapping[str, Any]], images: Sequence[Mapping[str, Any]], attribute: str, file: Path
) -> list[int]:
    """The bin of each annotation from 0, which the file counts from 1; -1 where neither it nor its image has one.

    Dots in ``attribute`` lead into entries of entries. ``file`` is for messages.

    Raises:
        ValueError: a bin that is no whole number from 1, or no bin at all.
    """
    where = f"{file}: target.bin_attribute={attribute!r}"
    of_image = {entry["id"]: _value(entry, attribute) for entry in images}
    bins = []
    for row, item in enumerate(annotations):
        value = _value(item, attribute)
        value = of_image.get(item["image_id"]) if value is None else value
        if value is not None and (type(value) is not int or value < 1):
            raise ValueError(
                f"{where}: want a whole number from 1, annotations[{row}] or its image has {value!r}"
            )
        bins.append(-1 if value is None else value - 1)
    if all(b < 0 for b in bins):
        raise ValueError(f"{where}: no annotation and no image has it")
    return bins


def _value(entry: Mapping[str, Any], attribute: str) -> Any:
    value: Any = entry
    for key in attribute.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
