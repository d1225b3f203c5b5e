"""What a page says about measured experiments, kept in a file next to it: runs of several machines fill one page."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.documents import markdown_table, write_json
from neural_sim.report import tracking
from neural_sim.report.identity import at_scale


@dataclass(frozen=True)
class Entry:
    """A row of a table of settings, with the commit of its own runs.

    Args:
        place: what it is about, and its place in the table: the experiment, then what sorts within it.
        cells: text by column.
        line: a line for the table of all experiments; empty: none.
        commits: commits of its runs' code.
    """

    place: tuple[str | int, ...]
    cells: Mapping[str, str]
    line: str = ""
    commits: Sequence[str] = ()


@dataclass(frozen=True)
class Measured:
    """What is known about one experiment.

    Args:
        lines: lines for the page's table.
        text: Markdown below it.
        commits: commits of the runs' code.
        entries: rows of a table above the text, with lines and commits of their own.
        costs: Markdown below the text about the methods' costs.
    """

    lines: Sequence[str]
    text: str
    commits: Sequence[str]
    entries: Sequence[Entry] = ()
    costs: str = ""

    @property
    def summary(self) -> list[str]:
        """All lines."""
        return [*self.lines, *(entry.line for entry in self.entries if entry.line)]

    @property
    def all_commits(self) -> list[str]:
        """Commits of the runs and of the entries' runs."""
        return sorted({*self.commits, *(commit for entry in self.entries for commit in entry.commits)})

    @property
    def cell(self) -> str:
        """The cell in the page's table."""
        return "<br>".join([*self.summary, f"(commit {', '.join(self.all_commits)})"])

    @property
    def below(self) -> str:
        """The text below the page's table."""
        parts = (table(self.entries) if self.entries else "", self.text, self.costs)
        return "\n\n".join(part for part in parts if part)

    def with_kept(self, kept: Measured | None, experiments: Sequence[str]) -> Measured:
        """Add the entries of ``kept`` for places that have none here, in the order of ``experiments``."""
        old = () if kept is None else kept.entries
        return dataclasses.replace(self, entries=merged(old, self.entries, experiments))


def merged(kept: Sequence[Entry], new: Sequence[Entry], experiments: Sequence[str]) -> tuple[Entry, ...]:
    """Return the entries of ``experiments`` in their order; ``new`` ones replace ``kept`` ones of the same place."""
    by_place = {entry.place: entry for entry in (*kept, *new)}
    known = [entry for entry in by_place.values() if entry.place[0] in experiments]
    return tuple(sorted(known, key=lambda entry: (experiments.index(str(entry.place[0])), *entry.place[1:])))


def table(entries: Sequence[Entry]) -> str:
    """Return a Markdown table with the columns of all entries; cells that an entry lacks are empty.

    Columns are in the order of the entry that has most.
    """
    most = max((entry.cells for entry in entries), key=len)
    columns = list(dict.fromkeys([*most, *(column for entry in entries for column in entry.cells)]))
    return markdown_table(columns, [[entry.cells.get(column, "") for column in columns] for entry in entries])


def document_of(page: str) -> Path:
    """Return the file that keeps the measured rows of a page."""
    return Path(page).with_suffix(".json")


def read_measured(file: Path, budget: Mapping[str, Any]) -> dict[str, Measured]:
    """Read the rows by name; empty if there is no such file, or if it is for another ``budget`` (the scale)."""
    if not file.is_file():
        return {}
    document = json.loads(file.read_text(encoding="utf-8"))
    rows = document["rows"] if at_scale(document["budget"], budget) else {}
    return {name: _row(**row) for name, row in rows.items()}


def _row(entries: Sequence[Mapping[str, Any]] = (), **row: Any) -> Measured:
    """Older files have no entries and no costs."""
    read = tuple(Entry(**{**entry, "place": tuple(entry["place"])}) for entry in entries)
    return Measured(**row, entries=read)


def write_measured(file: Path, budget: Mapping[str, Any], rows: Mapping[str, Measured]) -> None:
    """Write what ``read_measured`` reads."""
    write_json(
        file, {"budget": budget, "rows": {name: dataclasses.asdict(row) for name, row in rows.items()}}
    )


def newest_document(uri: str, experiment: str, name: str, budget: Mapping[str, Any]) -> Measured | None:
    """Read the Markdown file ``name`` of an experiment's newest finished run at the scale ``budget``; None without."""
    if experiment not in tracking.experiments(uri):
        return None
    for run in tracking.logged_runs(uri, experiment):
        own = {key: value for key, value in run.parameters.items() if key.startswith("budget.")}
        if run.status == "FINISHED" and name in run.files and at_scale(own, {"budget": budget}):
            return Measured(["below"], run.fetch(name).read_text(encoding="utf-8").strip(), [run.commit])
    return None
