"""Write files completely or not at all, read and write standard JSON, and make tables and Markdown sections."""

from __future__ import annotations

import json
import math
import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

PART = ".part"
"""Suffix of a file that is being written."""


def finite(tree: Any) -> Any:
    """Replace NaN and infinities, which standard JSON cannot hold, by None; tuples become lists."""
    if isinstance(tree, Mapping):
        return {key: finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def write_whole(path: Path, content: bytes | str) -> Path:
    """Write a file completely or not at all, and make its folder. Text is in UTF-8.

    Raises:
        OSError: the system's error, with the path added, which the error of a full disk lacks.
    """
    data = content.encode() if isinstance(content, str) else content
    part = path.with_name(f".{path.name}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(data)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise type(error)(error.errno, error.strerror or str(error), str(path)) from error
    return path


def write_json(path: Path, document: Any, indent: int | None = 1) -> Path:
    """Write a document as standard JSON in UTF-8, and make its folder; numbers that are not finite become null.

    Args:
        path: the file.
        document: mappings, sequences, strings, numbers, booleans and None.
        indent: spaces of indentation a level; None writes one line.

    Returns:
        ``path``.

    Raises:
        TypeError: JSON cannot hold a value.
        OSError: as ``write_whole``.
    """
    return write_whole(path, json.dumps(finite(document), indent=indent, allow_nan=False))


def parsed_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: the text is not JSON, or is nested too deeply for Python.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("its lists or mappings are nested too deeply") from error


def read_json(path: Path) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark.

    Raises:
        ValueError: the file is missing, cannot be read or is not JSON; the message has its path.
    """
    try:
        return parsed_json(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table; bars in cells are escaped.

    Args:
        head: titles of the columns.
        rows: cells of each row, as many as ``head`` has.

    Raises:
        ValueError: a row has another length.
    """
    lines = [_line(head), "|" + "---|" * len(head)]
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"markdown_table: want {len(head)} cells as in {list(head)}, got {list(row)}")
        lines.append(_line(row))
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(str(cell).replace("|", r"\|") for cell in cells) + " |"


def plain_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in plain text, the first column left-aligned; long titles are wrapped over their columns."""
    widths = [max(len(row[number]) for row in rows) for number in range(len(head))]
    titles = [textwrap.wrap(title, max(11, width)) for title, width in zip(head, widths, strict=True)]
    height = max(map(len, titles))
    stacked = [[""] * (height - len(lines)) + lines for lines in titles]
    lines = [*zip(*stacked, strict=True), *rows]
    first, *others = (max(len(line[number]) for line in lines) for number in range(len(head)))
    text = (
        line[0].ljust(first)
        + "".join(f"  {cell:>{width}}" for cell, width in zip(line[1:], others, strict=True))
        for line in lines
    )
    return "\n".join(map(str.rstrip, text))


def replace_section(path: Path, name: str, markdown: str) -> None:
    """Write the section ``## name`` of a Markdown file, which is created if it does not exist; other text is kept.

    The section stands between ``<!-- begin: name -->`` and ``<!-- end: name -->``; a new one goes to the end.

    Raises:
        ValueError: the file has one marker without the other, or has them out of order or more than once.
    """
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    body = markdown.rstrip().lstrip("\n")  # not leading spaces, which make a code block
    block = f"{begin}\n## {name}\n\n{body}\n\n{end}\n"
    text = path.read_text() if path.exists() else ""
    counts = text.count(begin), text.count(end)
    if counts == (0, 0):
        gap = "" if not text else "\n" if text.endswith("\n") else "\n\n"
        write_whole(path, text + gap + block)
        return
    first, last = text.find(begin), text.find(end)
    if counts != (1, 1) or last < first:
        raise ValueError(
            f"{path}: section {name!r} wants one begin and one end marker in order, got {counts}"
        )
    write_whole(path, text[:first] + block + text[last + len(end) :].removeprefix("\n"))
