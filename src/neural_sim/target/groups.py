"""Which images of a COCO file belong together: frames of one video, photographs of one scene."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ATTRIBUTE = "attribute:"


def groups_of(entries: Sequence[Mapping[str, Any]], split_by: str, file: Path) -> list[str]:
    """The group of each image entry.

    Args:
        entries: the file's image entries.
        split_by: ``attribute:<name>``, the group is that attribute of the entry; else a regular expression, searched
            for in ``file_name``: the group is its first capture group, or the whole match where it has none.
        file: where the entries are from, for messages.

    Raises:
        ValueError: a regular expression that does not compile, an image that it does not match or that lacks the
            attribute, or fewer than two groups.
    """
    where = f"target.split_by={split_by!r}, {file}"
    named = _attributes if split_by.startswith(ATTRIBUTE) else _matches
    groups = named(entries, split_by, where)
    lacking = [entry["file_name"] for entry, group in zip(entries, groups, strict=True) if group is None]
    if lacking:
        raise ValueError(
            f"{where}: {len(lacking)} of {len(entries)} images have no group, the first {lacking[0]!r}"
        )
    if len(set(groups)) < 2:
        raise ValueError(f"{where}: want at least two groups, got {sorted(set(map(str, groups)))}")
    return [str(group) for group in groups]


def _matches(entries: Sequence[Mapping[str, Any]], split_by: str, where: str) -> list[str | None]:
    try:
        pattern = re.compile(split_by)
    except re.error as error:
        raise ValueError(f"{where}: not a regular expression ({error})") from error
    matches = [pattern.search(str(entry["file_name"])) for entry in entries]
    return [None if match is None else match[min(1, pattern.groups)] for match in matches]


def _attributes(entries: Sequence[Mapping[str, Any]], split_by: str, where: str) -> list[Any]:
    name = split_by.removeprefix(ATTRIBUTE)
    values = [entry.get(name) for entry in entries]
    strange = next((value for value in values if isinstance(value, (dict, list))), None)
    if strange is not None:
        raise ValueError(f"{where}: want a text or a number, got {strange!r}")
    return values
