"""What a run cost, and the work that it did not have to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from neural_sim.stages.stage import Stage
from neural_sim.stages.store import Entry


@dataclass(frozen=True)
class Omission:
    """Work that a run leaves out, and why. ``fraction`` is relative to all work of that kind, ``seconds`` what it would
    take, where they are known.
    """

    stage: str
    what: str
    why: str
    fraction: float | None = None
    seconds: float | None = None


@dataclass
class Account:
    """Seconds by stage, and what was left out."""

    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[Omission] = field(default_factory=list)

    def reused(self, stage: Stage[Any], entry: Entry) -> None:
        """Count a result that the store had."""
        self.left_out.append(Omission(stage.name, stage.title, "found in the store", 1.0, entry.seconds))
