"""Time that a run spent on each phase, and work that it left out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Omission:
    """Work that a run leaves out.

    Args:
        stage: the phase of the run that would do it.
        what: the work.
        why: the reason.
        fraction: its share of all work of that kind, None if unknown.
        seconds: time that it would take, None if unknown.
    """

    stage: str
    what: str
    why: str
    fraction: float | None = None
    seconds: float | None = None


@dataclass
class Account:
    """Seconds that a run spent in each phase, and the work that it left out.

    A phase is charged for the time from its start to its end, excluding the phases inside it: time spent on a field
    counts for the field, whichever phase asks for it.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[Omission] = field(default_factory=list)
    _running: list[str] = field(default_factory=list)
    _since: float = 0.0

    @contextmanager
    def charged(self, phase: str) -> Iterator[None]:
        """Charge a phase for the time spent inside this context."""
        self._settle()
        self._running.append(phase)
        try:
            yield
        finally:
            self._settle()
            self._running.pop()

    def _settle(self) -> None:
        now = time.perf_counter()
        if self._running:
            phase = self._running[-1]
            self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self._since
        self._since = now

    def reused(self, phase: str, what: str, seconds: float) -> None:
        """Record a result found in the store, with the seconds that it took to compute."""
        self.left_out.append(Omission(phase, what, "found in the store", 1.0, seconds))
