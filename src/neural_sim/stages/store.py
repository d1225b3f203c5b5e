"""A content-addressed store of stage results: equal inputs are computed once.

Entries are written under a temporary name and moved into place, so that a killed run leaves no half-written entry.
A lock keeps two processes from computing the same result: other runs wait for the one that holds the lock, which is
freed when its process ends.

An entry is a line of text with the SHA-256 and the size of the rest of the file, followed by the output of
``torch.save``. Both are checked on every read; a damaged entry is set aside and made again.
Checkpoints of unfinished work are kept next to the entries, in the same format, until the result is finished.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import pickle
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from filelock import FileLock, Timeout
from torch import Tensor

from neural_sim.checkpoint import State

_log = logging.getLogger(__name__)

DAMAGED = ".damaged"
"""Suffix, instead of ``.pt``, of a damaged entry."""
CHECKPOINT = ".checkpoint"
"""Suffix, instead of ``.pt``, of a checkpoint of unfinished work."""
_SUFFIXES = (".pt", ".json", CHECKPOINT)
_HEADER = "neural-sim entry 1, sha256 {sha256:64}, bytes {size:20d}\n"


@dataclass(frozen=True)
class Entry:
    """A stored result. ``seconds`` is the time of its computation, even if it was ``reused`` from the store."""

    value: Any
    seconds: float
    reused: bool


@dataclass(frozen=True)
class Audit:
    """The contents of a store.

    Attributes:
        sound: entries whose content matches their checksum.
        damaged: entries whose content does not, or that cannot be read.
        left: other files, which killed runs left half-written or which were set aside as damaged.
        checkpoints: checkpoints of unfinished work.
        bytes: total size of the sound entries.
    """

    sound: list[Path]
    damaged: list[Path]
    left: list[Path]
    checkpoints: list[Path]
    bytes: int


@dataclass(frozen=True)
class Store:
    """Results under ``root/<kind>/<key>.pt``, with the description of the key next to each as JSON."""

    root: Path

    def fetch(self, kind: str, key: str, description: Mapping[str, Any], make: Callable[[], Any]) -> Entry:
        """Return the result ``key``, from the store or from ``make``.

        ``make`` returns tensors, numbers, strings, and lists and dicts of these: entries are read with
        ``weights_only``, so that a shared store cannot run code. A damaged or unreadable entry is set aside and made
        again, with a warning.

        Raises:
            ValueError: the store cannot be written to; the message has its path.
        """
        path = self._path(kind, key)
        with suppress(_Damage):  # handled below, under the lock
            if (entry := _read(path)) is not None:
                return entry
        with _writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            try:
                entry = _read(path)  # another process may have written it meanwhile
            except _Damage as damage:
                _set_aside(path, damage)
                entry = None
            if entry is not None:
                return entry
            _sweep(path)
            begin = time.perf_counter()
            value = make()
            seconds = time.perf_counter() - begin
            text = json.dumps(description, indent=1, sort_keys=True)
            _write(path.with_suffix(".json"), lambda file: file.write(text.encode()))
            _write(path, lambda file: _save({"value": value, "seconds": seconds}, file))
            self.forget(kind, key)
        return Entry(value, seconds, reused=False)

    def state(self, kind: str, key: str, classes: Sequence[type] = ()) -> Any:
        """Return the state of unfinished work on the result ``key``, None if there is none.

        Only the process that makes the result, and holds its lock, may call this. ``classes`` are the dataclasses that
        may occur in a state. A damaged checkpoint is set aside, with a warning, and the work starts again.
        """
        path = self._path(kind, key).with_suffix(CHECKPOINT)
        try:
            return _content(path, classes)
        except _Damage as damage:
            _set_aside(path, damage)
            return None

    def keep(self, kind: str, key: str, state: State) -> None:
        """Write a checkpoint of the result ``key``; if that fails, the work goes on with a warning."""
        path = self._path(kind, key).with_suffix(CHECKPOINT)
        try:
            with _writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, lambda file: _save(state, file))
        except ValueError as error:
            _log.warning("%s; the work goes on, but a later run cannot resume it from here", error)

    def revise(self, kind: str, key: str, change: Callable[[Any], State | None]) -> None:
        """Change the state of unfinished work to which several processes write, one at a time.

        If the store cannot be written to, the work goes on with a warning.

        Args:
            kind: kind of the result.
            key: key of the result.
            change: takes the state, None if there is none, and returns the new one; None removes it.
        """
        path = self._path(kind, key)
        try:
            with _writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            with locked(path):
                state = change(self.state(kind, key))
                if state is None:
                    self.forget(kind, key)
                else:
                    self.keep(kind, key, state)
        except ValueError as error:
            _log.warning("%s; the work goes on, but a later run cannot resume it from here", error)

    def forget(self, kind: str, key: str) -> None:
        """Remove the checkpoint of the result ``key``, if there is one."""
        path = self._path(kind, key).with_suffix(CHECKPOINT)
        with _writing(path):
            path.unlink(missing_ok=True)

    def has(self, kind: str, key: str) -> bool:
        """Return whether the store has a file of the result, without reading it."""
        return self._path(kind, key).is_file()

    def busy(self, kind: str, key: str) -> bool:
        """Return whether another run is making the result ``key``."""
        path = self._path(kind, key)
        if not path.with_suffix(".lock").exists():
            return False
        with locked(path, wait=False) as ours:
            return not ours

    def audit(self) -> Audit:
        """Check every entry against its checksum, and list all other files; nothing is changed."""
        sound, damaged, size = [], [], 0
        for path in sorted(self.root.glob("*/[!.]*.pt")):
            try:
                with path.open("rb") as file:
                    _checked_header(file)
                    size += file.seek(0, os.SEEK_END)
                sound.append(path)
            except (_Damage, OSError):
                damaged.append(path)
        drafts = (path for suffix in _SUFFIXES for path in self.root.glob(f"*/.*{suffix}.*"))
        left = [*drafts, *self.root.glob(f"*/*{DAMAGED}")]
        checkpoints = sorted(self.root.glob(f"*/[!.]*{CHECKPOINT}"))
        return Audit(sound, damaged, sorted(left), checkpoints, size)

    def _path(self, kind: str, key: str) -> Path:
        return self.root / kind / f"{key}.pt"


class _Damage(Exception):
    """A file is damaged; the message says how."""


@contextmanager
def locked(path: Path, wait: bool = True, key: str = "paths.store") -> Iterator[bool]:
    """Lock an entry. The operating system frees the lock when the process that holds it ends, however it ends.

    Yields whether this process got the lock; with ``wait``, it always does. Messages name ``key``, the setting
    that ``path`` comes from.
    """
    lock = _lock(path)
    with _writing(path, key):
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if wait:
                _log.info("%s: waiting for another run, which is making %s", key, path)
                lock.acquire()
    try:
        yield lock.is_locked
    finally:
        lock.release()


def _lock(path: Path) -> FileLock:
    return FileLock(path.with_suffix(".lock"))


def _read(path: Path) -> Entry | None:
    """Return an entry, None if there is none. Raises ``_Damage``."""
    stored = _content(path)
    if stored is None:
        return None
    if not isinstance(stored, dict) or stored.keys() != {"value", "seconds"}:
        raise _Damage(f"it holds a {type(stored).__name__}, want value and seconds")
    return Entry(stored["value"], stored["seconds"], reused=True)


def _content(path: Path, classes: Sequence[type] = ()) -> Any:
    """Return the content of a file, None if it does not exist. Raises ``_Damage``."""
    try:
        with path.open("rb") as file, torch.serialization.safe_globals(list(classes)):
            file.seek(_checked_header(file))
            return torch.load(file, weights_only=True)
    except FileNotFoundError:
        return None
    except (
        pickle.UnpicklingError
    ) as error:  # its own message advises weights_only=False, which would run code
        raise _Damage(
            "it holds something other than tensors, numbers, strings, lists and mappings"
        ) from error
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise _Damage(f"it cannot be read: {reason}") from error


def _checked_header(file: BinaryIO) -> int:
    """Check a file against its first line and return the length of that line. Raises ``_Damage``."""
    header = file.readline(len(_header("", 0)))
    if not header.startswith(_HEADER[:16].encode()):
        raise _Damage("it has no checksum, like entries of older versions")
    if header != _header(_sha256(file), file.tell() - len(header)):
        raise _Damage("its content does not match the checksum and size in its first line")
    return len(header)


def _save(content: Mapping[str, Any], file: BinaryIO) -> None:
    begin = len(_header("", 0))
    file.seek(begin)
    try:
        torch.save(content, file)
    except RuntimeError as error:  # raised by torch on closing an archive that could not be written
        if isinstance(error.__context__, OSError):
            raise error.__context__ from error
        raise
    size = file.tell() - begin
    file.seek(begin)
    sha256 = _sha256(file)
    file.seek(0)
    file.write(_header(sha256, size))


def _header(sha256: str, size: int) -> bytes:
    return _HEADER.format(sha256=sha256, size=size).encode()


def _sha256(file: BinaryIO) -> str:
    """Hash the rest of the file."""
    return hashlib.file_digest(file, "sha256").hexdigest()  # pyright: ignore[reportArgumentType]


def _set_aside(path: Path, damage: _Damage) -> None:
    entry = path.suffix == ".pt"
    aside = path.with_suffix(DAMAGED) if entry else path.with_name(path.name + DAMAGED)
    then = "the result is made again" if entry else "its work starts again"
    with _writing(path):
        os.replace(path, aside)
    _log.warning("store: %s is damaged (%s): it was renamed to %s, and %s", path, damage, aside.name, then)


def _sweep(path: Path) -> None:
    """Remove half-written files of killed runs from the folder of ``path``, whose lock is held."""
    for kind in _SUFFIXES:
        for left in path.parent.glob(f".*{kind}.*"):
            key = left.name[1:].rpartition(kind)[0]
            if key == path.stem:
                left.unlink(missing_ok=True)
                continue
            # Files that another run is writing, or that another user owns, are left alone.
            with suppress(Timeout, OSError), _lock(path.with_name(f"{key}.pt")).acquire(timeout=0):
                left.unlink()


def _write(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file completely or not at all, with the permissions of a new file."""
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    with _writing(path):
        try:
            with draft.open("x+b") as file:
                write(file)
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)


@contextmanager
def _writing(path: Path, key: str = "paths.store") -> Iterator[None]:
    """Turn an ``OSError`` from writing a file into a ``ValueError`` that names the file."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{key}: {path} cannot be written: {error.strerror or error}") from error


def to_bytes(images: Tensor) -> Tensor:
    """Return images in [0, 1] as integers from 0 to 255 on the CPU, as they are stored."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def from_bytes(images: Tensor) -> Tensor:
    """Return images stored by ``to_bytes`` as float32."""
    return images.to(torch.float32) / 255
