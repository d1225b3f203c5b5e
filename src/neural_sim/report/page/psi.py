"""The learned psi over the iterations, every bin with its picture, share and score, and the outcome of every step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from jaxtyping import UInt8
from matplotlib.colors import to_hex
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.report import figures
from neural_sim.report.figures import Figure, Thumbnails
from neural_sim.report.page import render
from neural_sim.report.page.pictures import picture
from neural_sim.report.page.weak_bins import BinScore
from neural_sim.report.run import Learned, RunResults

NEAR = 0.02
"""Total variation below which psi counts as unchanged."""


@dataclass(frozen=True)
class Tile:
    """A bin of an object.

    Args:
        number: number of the bin, from 1.
        source: source of its picture; None: there is none.
        colour: its colour in the charts.
        shares: fractions of the object's training images from this bin: ``initial``, ``learned`` and, if known,
            ``target``.
        same: other bins that look the same.
        score: score on the test images from this bin; None: there are too few, or bins of this factor are not known.
    """

    number: int
    source: str | None
    colour: str
    shares: Mapping[str, float]
    same: tuple[int, ...] = ()
    score: BinScore | None = None


@dataclass(frozen=True)
class ObjectPsi:
    """One object's distribution of a factor.

    Args:
        name: name of the object.
        chart: chart of its probabilities over the iterations.
        comment: remark on how it moved, see the function ``comment``.
        distances: distances from the target; empty: not known.
        tiles: its bins; empty for lights.
    """

    name: str
    chart: str
    comment: str
    distances: Mapping[str, float]
    tiles: tuple[Tile, ...]


def learned_psi(
    results: RunResults, bins: Thumbnails, scores: Sequence[BinScore]
) -> dict[str, list[ObjectPsi]]:
    """Return what was learned, by factor, with biased objects first; empty if nothing was learned."""
    found: dict[str, list[ObjectPsi]] = {}
    for factor in results.factors if results.moved else ():
        for one in sorted(results.of_factor(factor), key=lambda one: one.name not in results.biased):
            tiles = _tiles(one, bins.get(one.name, {}), scores)
            said = comment(one, results.records)
            found.setdefault(factor, []).append(
                ObjectPsi(one.name, psi_chart(one), said, one.distances, tiles)
            )
    return found


def _tiles(
    one: Learned, own: Mapping[str, UInt8[Tensor, "bins h w 3"]], scores: Sequence[BinScore]
) -> tuple[Tile, ...]:
    if own and one.factor not in own:  # lights
        return ()
    # Bins of test images are those of the first factor that has bins.
    scored = {s.bin: s for s in scores if s.name == one.name and one.factor == next(iter(own), one.factor)}
    colours = bin_colours(one.factor, len(one.p["learned"]))
    group_of = {number: group for group in one.groups for number in group}
    return tuple(
        Tile(
            number,
            picture(own[one.factor][number - 1]) if own else None,
            colour,
            {which: p[number - 1] for which, p in one.p.items()},
            tuple(other for other in group_of[number] if other != number),
            scored.get(number),
        )
        for number, colour in enumerate(colours, 1)
    )


def comment(one: Learned, records: Sequence[Mapping[str, Any]]) -> str:
    """Say what the chart does not: why psi did not move, that it went back, or that it moved away from the target."""
    backs = [record["taken_back"][one.name] for record in records if one.name in record["taken_back"]]
    if backs:
        kept, accepted = backs[-1]["kept"], backs[-1]["accepted"]
        where = f"to where it was after {kept} of {accepted} accepted steps" if kept else "to its start"
        return f"At the end, it went back {where}: later trainings did not bear out the others."
    start, end = one.p["initial"], one.p["learned"]
    if 0.5 * sum(abs(a - b) for a, b in zip(start, end, strict=True)) < NEAR:
        return _why_it_stayed(one, records)
    if one.distances and one.distances["learned"] > one.distances["initial"] + NEAR:
        return "It moved away from the target."
    return ""


def _why_it_stayed(one: Learned, records: Sequence[Mapping[str, Any]]) -> str:
    certificates = [record["certificate"] for record in records if record["certificate"]]
    actions = {c["actions"].get(one.name, {}).get(one.factor) for c in certificates} - {None}
    verdicts = [record["verdicts"][one.name] for record in records if one.name in record["verdicts"]]
    if verdicts and not any(verdict["accepted"] for verdict in verdicts):
        return "It did not move: trainings rejected its steps."
    if actions == {"skipped"}:
        return "It did not move: its derivative was never distinguished from zero."
    return "It did not move."


def bin_colours(factor: str, bins: int) -> list[str]:
    """Return the colours of a factor's bins in these charts."""
    return [to_hex(colour) for colour in figures.bin_colours(factor, bins)]


def psi_chart(learned: Learned) -> str:
    """Draw one object's probabilities over the iterations, with the target's next to them."""
    figure = Figure(figsize=(3.4, 2.1), layout="constrained")
    figures.psi_panel(figure.add_subplot(), learned)
    return render.data_uri(figure)


def shown_chart(one: FactorEstimate) -> str:
    """Draw the estimate from the target's boxes for one object and factor, next to psi."""
    figure = Figure(figsize=(3.4, 1.9), layout="constrained")
    figures.shown_panel(figure.add_subplot(), one)
    return render.data_uri(figure)


# --- steps ---

Kind = Literal["accepted", "rejected", "taken", "shrunk", "waited", "skipped", "none"]
SYMBOLS: Mapping[Kind, str] = {
    "accepted": "✓", "rejected": "✗", "taken": "→", "shrunk": "⇢", "waited": "…", "skipped": "·", "none": "",
}  # fmt: skip
_UNJUDGED: Mapping[str, Kind] = {
    "kept": "taken",
    "taken": "taken",
    "shrunk": "shrunk",
    "waited": "waited",
    "skipped": "skipped",
}
"""The kind of a step that no training judged, by the certificate's action.

If an object's factors differ, the first of their actions in this order is shown.
"""


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
