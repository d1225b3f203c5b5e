"""An account of what makes the host wait for a device, or moves anything between the two."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import neural_sim

PACKAGE = str(Path(neural_sim.__file__).parent)


@dataclass
class Ledger:
    """What the host waited for or moved, by (kind, operation, place); ``calls`` counts operations on the device.

    Kinds: ``wait`` (a number or a size that depends on values), ``to_host``, ``to_device``. The place is the innermost
    line of the package, none in a backward pass. ``moved`` are the bytes of the copies.
    """

    trips: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    moved: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    calls: int = 0

    def note(self, kind: str, operation: str, size: int = 0) -> None:
        key = (kind, operation, place())
        self.trips[key] += 1
        self.moved[key] += size

    def count(self, *kinds: str) -> int:
        return sum(
            n for (kind, _, _), n in self.trips.items() if kind in (kinds or ("wait", "to_host", "to_device"))
        )

    def table(self) -> str:
        rows = [f"{n:7} {self.moved[key]:12} {' '.join(key)}" for key, n in self.trips.most_common()]
        return "\n".join([f"{self.calls} calls, {self.count()} trips", *rows])


ledgers: list[Ledger] = []
"""The last one counts."""


def place() -> str:
    """The innermost line of the package that is being run, none outside of it."""
    frame = sys._getframe(2)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(PACKAGE):
            return f"{name[len(PACKAGE) + 1 :]}:{frame.f_lineno} {frame.f_code.co_name}"
        frame = frame.f_back
    return ""


@contextmanager
def counted() -> Iterator[Ledger]:
    """A ledger of its own for what happens inside."""
    ledgers.append(Ledger())
    try:
        yield ledgers[-1]
    finally:
        ledgers.pop()
