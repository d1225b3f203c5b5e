"""Results shown on a page, kept in a file next to it, so that runs from several machines can fill one page."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.configuration import UserError
from neural_sim.documents import markdown_table, read_json, write_json
from neural_sim.report import tracking
from neural_sim.report.identity import at_scale
from neural_sim.report.tracking import flatten


@dataclass(frozen=True)
class Entry:
    """A row in a table of settings, with the commits of its own runs.

    Args:
        place: identity and sort key of the row: the experiment, then keys within it.
        cells: text by column.
        line: a line for the table of all experiments; empty: none.
        commits: code commits of its runs.
    """

    place: tuple[str | int, ...]
    cells: Mapping[str, str]
    line: str = ""
    commits: Sequence[str] = ()


@dataclass(frozen=True)
class Measured:
    """The results of one experiment.

    Args:
        lines: lines in the table of the page.
        text: Markdown below that table.
        commits: code commits of the runs.
        entries: rows of a table above the text, with their own lines and commits.
        costs: Markdown below the text, on the costs of the methods.
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
        """Code commits of all runs, including those of the entries."""
        return sorted({*self.commits, *(commit for entry in self.entries for commit in entry.commits)})

    @property
    def cell(self) -> str:
        """The cell in the table of the page."""
        return "<br>".join([*self.summary, f"(commit {', '.join(self.all_commits)})"])

    @property
    def below(self) -> str:
        """The text below the table of the page."""
        parts = (table(self.entries) if self.entries else "", self.text, self.costs)
        return "\n\n".join(part for part in parts if part)

    def with_kept(self, kept: Measured | None, experiments: Sequence[str]) -> Measured:
        """Return these results with the entries of ``kept`` for places without one here, ordered by ``experiments``."""
        old = () if kept is None else kept.entries
        return dataclasses.replace(self, entries=merged(old, self.entries, experiments))


def merged(kept: Sequence[Entry], new: Sequence[Entry], experiments: Sequence[str]) -> tuple[Entry, ...]:
    """Return the entries of ``experiments``, in that order; ``new`` ones replace ``kept`` ones at the same place."""
    by_place = {entry.place: entry for entry in (*kept, *new)}
    known = [entry for entry in by_place.values() if entry.place[0] in experiments]
    return tuple(sorted(known, key=lambda entry: (experiments.index(str(entry.place[0])), *entry.place[1:])))


def table(entries: Sequence[Entry]) -> str:
    """Return a Markdown table with the columns of all entries; cells that an entry lacks are empty.

    Columns are ordered as in the entry with the most columns.
    """
    most = max((entry.cells for entry in entries), key=len)
    columns = list(dict.fromkeys([*most, *(column for entry in entries for column in entry.cells)]))
    return markdown_table(columns, [[entry.cells.get(column, "") for column in columns] for entry in entries])


def document_of(page: str) -> Path:
    """Return the file that keeps the results shown on a page."""
    return Path(page).with_suffix(".json")


def read_measured(file: Path, budget: Mapping[str, Any]) -> dict[str, Measured]:
    """Read results by row name; empty if the file does not exist.

    Raises:
        UserError: its results are for another ``budget`` (scale); a page holds one scale, so writing it would lose
            them.
        ValueError: the file cannot be read as JSON.
    """
    if not file.is_file():
        return {}
    document = read_json(file)
    if not at_scale(document["budget"], budget):
        had, have = flatten(document["budget"]), flatten(budget)
        changes = [
            f"budget.{key} was {had[key]} and {f'is {have[key]} now' if key in have else 'is gone'}"
            for key in had
            if str(had[key]) != str(have.get(key))
        ]
        raise UserError(
            f"experiments.page: the results in {file} are for another scale ({(changes or ['it names none'])[0]}); "
            "want that scale, or another page"
        )
    return {name: _row(**row) for name, row in document["rows"].items()}


def _row(entries: Sequence[Mapping[str, Any]] = (), **row: Any) -> Measured:
    """Read one row; files of older versions have no entries and no costs."""
    read = tuple(Entry(**{**entry, "place": tuple(entry["place"])}) for entry in entries)
    return Measured(**row, entries=read)


def write_measured(file: Path, budget: Mapping[str, Any], rows: Mapping[str, Measured]) -> None:
    """Write results for ``read_measured``."""
    write_json(
        file, {"budget": budget, "rows": {name: dataclasses.asdict(row) for name, row in rows.items()}}
    )


def newest_document(uri: str, experiment: str, name: str, budget: Mapping[str, Any]) -> Measured | None:
    """Read the Markdown file ``name`` of an experiment's newest finished run at this ``budget``; None without one."""
    if experiment not in tracking.experiments(uri):
        return None
    for run in tracking.logged_runs(uri, experiment):
        own = {key: value for key, value in run.parameters.items() if key.startswith("budget.")}
        if run.status == "FINISHED" and name in run.files and at_scale(own, {"budget": budget}):
            return Measured(["below"], run.fetch(name).read_text(encoding="utf-8").strip(), [run.commit])
    return None
