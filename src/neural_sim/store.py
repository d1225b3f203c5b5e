"""A content-addressed store of stage results: what was made once from the same inputs is not made again.

A key covers the configuration that made a result, the digests of its inputs and the version of the code.
Entries are written to a temporary name and moved into place, so that a killed run leaves none half written and
runs side by side can share a store.
"""

from __future__ import annotations

import ast
import hashlib
import json
import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """A stored result. ``seconds`` is what it took to make, also when it was found rather than made."""

    key: str
    value: Any
    seconds: float
    found: bool


@dataclass
class Store:
    """Results under ``root/<stage>/<key>.pt``, with the key's description beside each as JSON."""

    root: Path
    hits: dict[str, int] = field(default_factory=dict)

    def fetch(self, stage: str, description: Mapping[str, Any], make: Callable[[], Any]) -> Entry:
        """The result for ``description``, from the store or from ``make``.

        ``make`` returns tensors, numbers, strings and lists and dicts of these: all that is read back is read
        with ``weights_only``, so that a shared store cannot run code. An unreadable entry is made again, with
        a warning.
        """
        key = digest(description)
        path = self.root / stage / f"{key}.pt"
        if path.is_file():
            try:
                held = torch.load(path, weights_only=True)
                self.hits[stage] = self.hits.get(stage, 0) + 1
                return Entry(key, held["value"], held["seconds"], found=True)
            except (OSError, RuntimeError, EOFError, KeyError, ValueError) as error:
                _log.warning("store: %s cannot be read (%s); it is made again", path, error)
        begin = time.perf_counter()
        value = make()
        seconds = time.perf_counter() - begin
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, lambda name: torch.save({"value": value, "seconds": seconds}, name))
        text = json.dumps(description, indent=1, sort_keys=True, default=str)
        _write(path.with_suffix(".json"), lambda name: Path(name).write_text(text))
        return Entry(key, value, seconds, found=False)


def digest(description: Mapping[str, Any]) -> str:
    """Twenty hex digits of the SHA-256 of a description's canonical JSON.

    Raises:
        TypeError: a value that JSON cannot hold; a key must not depend on an object's address.
    """
    text = json.dumps(description, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def tensor_digest(tensors: Iterable[torch.Tensor]) -> str:
    """Digest of shapes, dtypes and values, for results whose inputs are tensors (such as psi)."""
    total = hashlib.sha256()
    for tensor in tensors:
        held = tensor.detach().cpu().contiguous()
        total.update(f"{held.dtype}{tuple(held.shape)}".encode())
        total.update(held.numpy().tobytes())
    return total.hexdigest()[:20]


@lru_cache
def code_version(*rooms: str) -> str:
    """Digest of the code of rooms (packages or modules of this one) without comments, layout and docstrings.

    A stage's key carries the version of the rooms that make it, so that an edit which can change its result
    retires stored ones, and an edit of prose does not.
    """
    package = Path(__file__).parent
    total = hashlib.sha256()
    for room in rooms:
        place = package / room
        files = sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]
        for path in files:
            total.update(ast.dump(_without_docstrings(ast.parse(path.read_text()))).encode())
    return total.hexdigest()[:12]


def _without_docstrings(tree: ast.AST) -> ast.AST:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                node.body = body[1:]  # pyright: ignore[reportAttributeAccessIssue]
    return tree


def _write(path: Path, write: Callable[[str], object]) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        write(name)
        os.replace(name, path)
    finally:
        if os.path.exists(name):
            os.unlink(name)
