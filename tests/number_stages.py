"""Stages of numbers, in a module that other processes can import."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch

from neural_sim.stages.stage import UNKEYED, Stage


@dataclass(frozen=True)
class Number(Stage[dict]):
    """A value plus those of its inputs, with the process that made it and when; ``begun`` gets a line at once."""

    phase: ClassVar[str] = "numbers"
    kind: ClassVar[str] = "number"

    value: int
    of: tuple[Stage, ...] = ()
    seconds: float = field(default=0.0, metadata=UNKEYED)
    begun: Path | None = field(default=None, metadata=UNKEYED)
    hook: Callable | None = field(default=None, metadata=UNKEYED)

    @property
    def title(self):
        return f"number {self.value}"

    def make(self, results):
        begun = time.time()
        if self.begun is not None:
            with self.begun.open("a") as stream:
                stream.write(f"{self.value} {os.getpid()}\n")
        total = self.value + sum(results(stage)["total"] for stage in self.of)
        logging.getLogger(__name__).warning("made %d with %d threads", self.value, torch.get_num_threads())
        if self.value < 0:
            raise ValueError(f"number {self.value}: want at least 0")
        if self.value == 666:
            os._exit(9)
        time.sleep(self.seconds)
        return {"total": total, "process": os.getpid(), "begun": begun, "ended": time.time()}


@dataclass(frozen=True)
class Sum(Number):
    """A number that stays in memory."""

    stored: ClassVar[bool] = False
    kind: ClassVar[str] = "sum"


def entries(root: Path) -> int:
    return len(list(root.glob("number/*.pt")))
