"""Checkpoints: long work writes its state now and then, and a later run continues from it if this one is killed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

State = Mapping[str, Any]
"""Tensors on the CPU, numbers, strings, lists, tuples and mappings of these, dataclasses that the reader knows."""


class Checkpoint:
    """The state of one piece of work.

    Args:
        read: returns the state that was written last, None without one.
        write: writes a state in its place.
        every: seconds from one writing to the next, at least.
    """

    def __init__(
        self, read: Callable[[], State | None], write: Callable[[State], object], every: float = 0.0
    ) -> None:
        self.read, self._write, self._every = read, write, every
        self._written = time.monotonic()

    def offer(self, state: Callable[[], State | None]) -> None:
        """Write what ``state`` returns if it is time to; None: the work is where it cannot be taken up, ask again."""
        if time.monotonic() - self._written < self._every:
            return
        if (now := state()) is not None:
            self._write(now)
            self._written = time.monotonic()
