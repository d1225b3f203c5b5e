"""What a page says of measured experiments, kept in a file beside it: so runs of several machines fill one page."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.report import logged
from neural_sim.report.entries import Entry, merged, table
from neural_sim.report.identity import at_scale


@dataclass(frozen=True)
class Measured:
    """``lines`` for the page's table, ``text`` in Markdown below it, and the ``commits`` of the runs' code. ``entries``
    bring lines and commits of their own, and stand in a table above the text.
    """

    lines: Sequence[str]
    text: str
    commits: Sequence[str]
    entries: Sequence[Entry] = ()

    @property
    def summary(self) -> list[str]:
        """All lines."""
        return [*self.lines, *(entry.line for entry in self.entries if entry.line)]

    @property
    def cell(self) -> str:
        """In the page's table."""
        commits = sorted({*self.commits, *(commit for entry in self.entries for commit in entry.commits)})
        return "<br>".join([*self.summary, f"(commit {', '.join(commits)})"])

    @property
    def below(self) -> str:
        """Below the page's table."""
        return "\n\n".join(part for part in (table(self.entries) if self.entries else "", self.text) if part)

    def with_kept(self, kept: Measured | None, experiments: Sequence[str]) -> Measured:
        """With the entries of ``kept`` that it has none in the place of, in the order of ``experiments``."""
        old = () if kept is None else kept.entries
        return dataclasses.replace(self, entries=merged(old, self.entries, experiments))


def beside(page: str) -> Path:
    """The file that keeps the measured rows of a page."""
    return Path(page).with_suffix(".json")


def read_measured(file: Path, budget: Mapping[str, Any]) -> dict[str, Measured]:
    """The rows by name; none where there is no such file, or where it is of another ``budget`` (the scale)."""
    if not file.is_file():
        return {}
    document = json.loads(file.read_text())
    rows = document["rows"] if at_scale(document["budget"], budget) else {}
    return {name: _row(**row) for name, row in rows.items()}


def _row(entries: Sequence[Mapping[str, Any]] = (), **row: Any) -> Measured:
    """Files of before there were entries have none."""
    read = tuple(Entry(**{**entry, "place": tuple(entry["place"])}) for entry in entries)
    return Measured(**row, entries=read)


def write_measured(file: Path, budget: Mapping[str, Any], rows: Mapping[str, Measured]) -> None:
    """What :func:`read_measured` reads."""
    document = {"budget": budget, "rows": {name: dataclasses.asdict(row) for name, row in rows.items()}}
    file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")


def newest_document(uri: str, experiment: str, name: str, budget: Mapping[str, Any]) -> Measured | None:
    """The Markdown file ``name`` of the newest finished run of an experiment at the scale ``budget``; None without."""
    if experiment not in logged.experiments(uri):
        return None
    for run in logged.runs(uri, experiment):
        own = {key: value for key, value in run.parameters.items() if key.startswith("budget.")}
        if run.status == "FINISHED" and name in run.files and at_scale(own, {"budget": budget}):
            return Measured(["below"], run.fetch(name).read_text().strip(), [run.commit])
    return None
