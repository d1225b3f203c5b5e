"""Rows of a table of settings, each with the commit of its runs: so runs of several machines fill one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """One setting of an experiment.

    Args:
        place: what it is of, and where it stands in the table: the experiment, then what sorts within it.
        cells: text by column.
        line: for the table of all experiments; empty: none.
        commits: of the code of its runs.
    """

    place: tuple[str | int, ...]
    cells: Mapping[str, str]
    line: str = ""
    commits: Sequence[str] = ()


def merged(kept: Sequence[Entry], new: Sequence[Entry], experiments: Sequence[str]) -> tuple[Entry, ...]:
    """The entries of ``experiments`` in their order; those of ``new`` stand for ``kept`` ones of the same place."""
    by_place = {entry.place: entry for entry in (*kept, *new)}
    known = [entry for entry in by_place.values() if entry.place[0] in experiments]
    return tuple(sorted(known, key=lambda entry: (experiments.index(str(entry.place[0])), *entry.place[1:])))


def table(entries: Sequence[Entry]) -> str:
    """Markdown, with the columns of all entries, in the order of the entry that has most; cells that an entry lacks are
    empty.
    """
    most = max((entry.cells for entry in entries), key=len)
    columns = list(dict.fromkeys([*most, *(column for entry in entries for column in entry.cells)]))
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for entry in entries:
        lines.append("| " + " | ".join(entry.cells.get(column, "") for column in columns) + " |")
    return "\n".join(lines)
