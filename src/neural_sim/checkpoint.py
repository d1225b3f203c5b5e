"""Checkpoints: long work writes its state now and then, and a later run continues from it if this one is killed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

State = Mapping[str, Any]
"""Tensors on the CPU, numbers, strings, dataclasses that the reader knows, and lists, tuples and mappings of these."""


class Checkpoint:
    """The state of one piece of work.

    Args:
        read: returns the state that was written last, None if there is none.
        write: writes a state that replaces the last one.
        every: smallest number of seconds between two writes.
    """

    def __init__(
        self, read: Callable[[], State | None], write: Callable[[State], object], every: float = 0.0
    ) -> None:
        self.read, self._write, self._every = read, write, every
        self._written = time.monotonic()

    def offer(self, state: Callable[[], State | None]) -> None:
        """Write what ``state`` returns, if enough time has passed since the last write.

        ``state`` returns None while the work cannot be resumed from its present point; the next call tries again.
        """
        if time.monotonic() - self._written < self._every:
            return
        if (now := state()) is not None:
            self._write(now)
            self._written = time.monotonic()
