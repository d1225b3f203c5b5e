"""The outcome of every object's step in every iteration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["accepted", "rejected", "taken", "shrunk", "waited", "skipped", "stopped", "none"]
SYMBOLS: Mapping[Kind, str] = {
    "accepted": "✓", "rejected": "✗", "taken": "→", "shrunk": "⇢", "waited": "…", "skipped": "·", "stopped": "■",
    "none": "",
}  # fmt: skip
_UNJUDGED: Mapping[str, Kind] = {
    "kept": "taken",
    "shrunk": "shrunk",
    "stopped": "stopped",
    "waited": "waited",
    "skipped": "skipped",
}
"""The kind of a step that was not judged, by the certificate's actions; the first that any factor has is shown."""


@dataclass(frozen=True)
class StepCell:
    """One object's step in one iteration; ``note`` has its numbers."""

    kind: Kind
    note: str

    @property
    def symbol(self) -> str:
        """One character, so that the table does not depend on colour."""
        return SYMBOLS[self.kind]


@dataclass(frozen=True)
class StepRow:
    """The steps of one object."""

    name: str
    cells: tuple[StepCell, ...]


def step_rows(records: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[StepRow]:
    """Return one row per object; none if the method computes no hypergradient.

    A step is judged when the next iteration begins, so its verdict is in the next record.
    """
    steps = [record for record in records if record["certificate"]]
    if not steps:
        return []
    rows = []
    for name in names:
        cells = []
        for iteration, record in enumerate(records):
            following = records[iteration + 1]["verdicts"] if iteration + 1 < len(records) else {}
            if record["certificate"]:
                cells.append(_cell(record["certificate"], following.get(name), name))
        rows.append(StepRow(name, tuple(cells)))
    return rows


def _cell(certificate: Mapping[str, Any], verdict: Mapping[str, Any] | None, name: str) -> StepCell:
    actions = certificate["actions"].get(name, {})
    p_values = certificate["p_values"].get(name, {})
    parts = [f"{factor}: p = {value:.2g}" for factor, value in p_values.items() if not math.isnan(value)]
    if certificate["doubts"]:
        parts.append("doubts: " + ", ".join(certificate["doubts"]))
    if verdict is None:
        kinds = set(actions.values())
        shown: list[Kind] = [kind for action, kind in _UNJUDGED.items() if action in kinds]
        return StepCell(shown[0] if shown else "none", "; ".join(parts))
    expected = f"expected fall of the outer loss {verdict['expected_gain']:.3f}"
    measured = f"measured rise of the object's score {verdict['measured_gain']:.3f} ± {verdict['error']:.3f}"
    parts += [expected, measured]
    judged: Kind = "accepted" if verdict["accepted"] else "rejected"
    return StepCell(judged, "; ".join(parts))
