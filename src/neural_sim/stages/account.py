"""What a run cost by its phases, and the work that it did not have to do."""

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
        fraction: of all work of that kind, None if unknown.
        seconds: what it would take, None if unknown.
    """

    stage: str
    what: str
    why: str
    fraction: float | None = None
    seconds: float | None = None


@dataclass
class Account:
    """Seconds by phase of a run, and what was left out.

    A phase is charged for the time between beginning and end without that of the phases inside it: a field counts as
    a field whoever asks for it.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[Omission] = field(default_factory=list)
    _running: list[str] = field(default_factory=list)
    _since: float = 0.0

    @contextmanager
    def charged(self, phase: str) -> Iterator[None]:
        """Charge the time inside to a phase."""
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
        """Note a result that the store had, and the seconds that it took when it was computed."""
        self.left_out.append(Omission(phase, what, "found in the store", 1.0, seconds))
