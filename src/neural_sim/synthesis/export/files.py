"""Files that are whole or not there: written under a temporary name, then renamed."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

PART = ".part"
"""Suffix of a file that is being written."""


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file, with its folder, at once.

    Raises:
        ValueError: the system does not let it be written, with the file and the reason.
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
        raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error


def write_json(path: Path, document: Any, indent: int | None = None) -> None:
    """A JSON file, whole or not there."""
    write_whole(path, json.dumps(document, allow_nan=False, indent=indent) + "\n")


def same_file(source: Path, path: Path) -> None:
    """``path`` as another name of ``source``; as a copy where the file system has no such names."""
    if path.exists():
        return
    part = path.with_name(f".{path.name}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.unlink(missing_ok=True)
            try:
                os.link(source, part)
            except OSError:
                shutil.copyfile(source, part)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"export.folder: {path} cannot be written: {error.strerror or error}") from error


def remove_parts(folder: Path) -> None:
    """Remove what a killed process left unfinished."""
    for path in folder.rglob(f".*{PART}"):
        path.unlink(missing_ok=True)
