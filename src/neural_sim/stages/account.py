"""What a run cost, and the work that it did not have to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from neural_sim.stages.stage import Stage
from neural_sim.stages.store import Entry


@dataclass(frozen=True)
class Omission:
    """Work that a run does not do, and why. ``share`` is the part of that kind of work, ``seconds`` what it would
    take, where they are known."""

    stage: str
    what: str
    why: str
    share: float | None = None
    seconds: float | None = None


@dataclass
class Account:
    """Seconds by stage, and what was left out."""

    seconds: dict[str, float] = field(default_factory=dict)
    left_out: list[Omission] = field(default_factory=list)

    def found(self, stage: Stage[Any], entry: Entry) -> None:
        """Count a result that the store had."""
        self.left_out.append(Omission(stage.name, stage.title, "found in the store", 1.0, entry.seconds))
