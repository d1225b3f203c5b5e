"""A content-addressed store of stage results: equal inputs are computed once.

Entries are written to a temporary name and moved into place, so that a killed run leaves none half written. Computation
is locked between processes: concurrent runs wait for a result that one of them is computing. A lock ends with its
process.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from torch import Tensor

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """A stored result. ``seconds`` is the time of its computation, also where it is ``reused`` from the store."""

    value: Any
    seconds: float
    reused: bool


@dataclass(frozen=True)
class Store:
    """Results under ``root/<kind>/<key>.pt``, with the key's description beside each as JSON."""

    root: Path

    def fetch(self, kind: str, key: str, description: Mapping[str, Any], make: Callable[[], Any]) -> Entry:
        """Return the result ``key``, from the store or from ``make``.

        ``make`` returns tensors, numbers, strings and lists and dicts of these: all that is read back is read
        with ``weights_only``, so that a shared store cannot run code. An unreadable entry is computed again, with
        a warning.
        """
        path = self._path(kind, key)
        entry = _read(path)
        if entry is not None:
            return entry
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            entry = _read(path)  # another process may have written it meanwhile
            if entry is not None:
                return entry
            begin = time.perf_counter()
            value = make()
            seconds = time.perf_counter() - begin
            text = json.dumps(description, indent=1, sort_keys=True)
            _write(path.with_suffix(".json"), lambda name: Path(name).write_text(text))
            _write(path, lambda name: torch.save({"value": value, "seconds": seconds}, name))
        return Entry(value, seconds, reused=False)

    def has(self, kind: str, key: str) -> bool:
        """Whether there is a file of the result; it is not read."""
        return self._path(kind, key).is_file()

    def _path(self, kind: str, key: str) -> Path:
        return self.root / kind / f"{key}.pt"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Alone with an entry. The operating system frees the lock when its holder ends, however that ends."""
    lock = FileLock(path.with_suffix(".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        _log.info("store: waiting for another run, which is making %s", path)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _read(path: Path) -> Entry | None:
    if not path.is_file():
        return None
    try:
        stored = torch.load(path, weights_only=True)
        return Entry(stored["value"], stored["seconds"], reused=True)
    except (OSError, RuntimeError, EOFError, KeyError, ValueError, pickle.UnpicklingError) as error:
        _log.warning("store: %s cannot be read (%s); it is made again", path, error)
        return None


def _write(path: Path, write: Callable[[str], object]) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        write(name)
        os.replace(name, path)
    finally:
        if os.path.exists(name):
            os.unlink(name)


def to_bytes(images: Tensor) -> Tensor:
    """Return images in [0, 1] as 0 to 255, as they are stored; on the CPU."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def from_bytes(images: Tensor) -> Tensor:
    """Return what :func:`to_bytes` stored, as float32."""
    return images.to(torch.float32) / 255
