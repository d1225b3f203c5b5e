"""Results of an experiment: its settings, each with its runs and their scores, and the rows of a page.

If runs were scored in several ways, those scored like the newest count. Rows are kept in a file next to the page, so
that runs from several machines can fill one page.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from neural_sim.configuration import UserError
from neural_sim.digests import digest
from neural_sim.documents import markdown_table, read_json, write_json
from neural_sim.report import tracking
from neural_sim.report.identity import at_scale, scale_of, scored_values
from neural_sim.report.intervals import Estimate, points
from neural_sim.report.runs import BOUNDS, WITHOUT, FinishedRun, Group, LeftOut, Runs, score_table, select
from neural_sim.report.score_table import ScoreTable
from neural_sim.report.tracking import UNKNOWN

AXES = re.compile(r"parameter\.\w+\.(gap|biased)\b|training\.real\.(mode|count|fraction)$")
"""Keys of a configuration in which the settings of one experiment differ: starts and targets of biased objects, and the
number and use of photographs in training."""
MEAN = "mAP"
"""Name under which the mean over biased objects is listed with the objects."""
CALLED = {"ns": "NS", "matched": "matched", "neural_sim": "NSO", "auto_sim": "Auto-Sim", "lts": "LTS"}


def called(method: str) -> str:
    """Return the paper's name of a method, or our own."""
    return CALLED.get(method, method)


@dataclass(frozen=True)
class Setting:
    """One start and target of an experiment, with the runs of all methods and seeds and their scores.

    Args:
        group: the runs.
        reference: the method that the others are compared with.
        table: scores of the biased objects.
    """

    group: Group
    reference: str
    table: ScoreTable

    @staticmethod
    def of(group: Group, reference: str, draws: int, seed: int = 0) -> Setting:
        """Score the runs of a group; ``draws`` and ``seed`` are those of the bootstrap."""
        return Setting(group, reference, score_table(group.runs, reference, draws, seed))

    @property
    def first(self) -> FinishedRun:
        """One of the runs, to read what all have in common."""
        return self.group.runs[0]

    @property
    def experiment(self) -> str:
        """The experiment of its runs."""
        return self.first.results["experiment"]

    @property
    def gap(self) -> str:
        """The kind of start: same, uniform or disjoint."""
        return self.first.results["gap"]

    @property
    def seeds(self) -> str:
        """The seeds that all methods have, as text."""
        return ", ".join(map(str, self.group.seeds))

    @property
    def objects(self) -> tuple[str, ...]:
        """The biased objects."""
        return self.table.classes

    @cached_property
    def methods(self) -> list[str]:
        """The detectors in the order of columns: ns, the methods, of which the reference is the last, and matched."""
        learned = [name for name in self.table.detectors if name not in (*BOUNDS, *WITHOUT, self.reference)]
        order = ["ns", *sorted(learned, reverse=True), self.reference, "matched"]
        return [name for name in order if name in self.table.detectors]

    @property
    def columns(self) -> list[str]:
        """``methods`` and, if training used photographs, detectors trained without them or without synthetic images."""
        return [*self.methods, *(name for name in WITHOUT if name in self.table.detectors)]

    @property
    def commits(self) -> list[str]:
        """Code commits of the runs."""
        return sorted({run.results.get("commit") or UNKNOWN for run in self.group.runs})

    @property
    def of_reference(self) -> list[Mapping[str, Any]]:
        """The results.json of the reference's runs, one per seed."""
        return [run.results for run in self.group.runs if run.method == self.reference]

    def score(self, method: str, name: str = MEAN) -> Estimate:
        """Return the score of a detector on an object, or its mean over objects."""
        return self._of(name).mean(method)

    def ahead(self, method: str, name: str = MEAN) -> Estimate:
        """Return the score of the reference minus that of a method."""
        return self._of(name).ahead(self.reference, method)

    def _of(self, name: str) -> ScoreTable:
        return self.table if name == MEAN else self.table.of_classes([name])

    def verdict(self, name: str = MEAN) -> str:
        """Give the score of the reference and its lead over each method, in words."""
        ours = points(self.score(self.reference, name))
        others = [method for method in self.methods if method not in (self.reference, "matched")]
        ahead = [f"{called(method)} by {points(self.ahead(method, name))}" for method in others]
        return f"{called(self.reference)} {ours}" + (f"; ahead of {', '.join(ahead)}" if ahead else "")

    def distribution(self, which: str, name: str, factor: str) -> list[float]:
        """Return the ``initial`` or ``target`` distribution of an object."""
        return self.first.results["psi"][name][factor][which]

    def factors(self, name: str) -> list[str]:
        """Return the factors that are learned for an object."""
        return list(self.first.results["psi"][name])


@dataclass(frozen=True)
class Settings:
    """Read the settings of experiments from MLflow.

    Args:
        uri: address of the MLflow store.
        budget: the ``budget`` (scale) that runs must have in their configuration; others are left out.
        reference: the method that the others are compared with.
        draws: number of bootstrap draws.
        seed: seed of the bootstrap.
    """

    uri: str
    budget: Mapping[str, Any]
    reference: str
    draws: int
    seed: int

    def read(self, experiments: Sequence[str]) -> tuple[list[Setting], list[LeftOut]]:
        """Return the settings of experiments, and the runs that are left out.

        Settings are ordered by experiment, and those of one experiment from the newest to the oldest.
        """
        known = tracking.experiments(self.uri)
        groups, left_out = self.groups(Runs.read(self.uri, [name for name in experiments if name in known]))
        groups.sort(key=lambda group: experiments.index(group.runs[0].experiment))
        return [Setting.of(group, self.reference, self.draws, self.seed) for group in groups], left_out

    def groups(self, runs: Runs) -> tuple[list[Group], list[LeftOut]]:
        """Return groups of runs that are scored like the newest of their experiment, and runs that are left out."""
        right = runs.without(lambda run: None if self._at_scale(run) else "it was run at another scale")
        found, left_out = select(right, self.reference)
        newest: dict[str, str] = {}
        for run in right.rows:
            if run.unusable is None and run.method == self.reference and run.results.get("scoring"):
                newest.setdefault(run.experiment, _way(run))
        groups = [group for group in found if _way(group.runs[0]) == newest[group.runs[0].experiment]]
        older = [run for group in found if group not in groups for run in group.runs]
        reason = "newer runs of the experiment are scored in another way"
        return groups, [*left_out, *(LeftOut.of(run, reason) for run in older)]

    def _at_scale(self, run: FinishedRun) -> bool:
        if run.unusable is not None:
            return True  # such runs are left out for another reason
        return at_scale(run.results.get("config", {}).get("budget") or {}, self.budget)


def _way(run: FinishedRun) -> str:
    """Return a digest of everything that scores depend on, except ``AXES``."""
    values = scored_values(run.results)
    return digest({key: value for key, value in values.items() if not AXES.match(key)})


def modes(p: Sequence[float]) -> str:
    """Abbreviate a distribution: the bins, from 1, with more than an equal share, or ``uniform``."""
    more = [str(bin) for bin, value in enumerate(p, 1) if value * len(p) > 1.05]
    return ", ".join(more) or "uniform"


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

    lines: Sequence[str] = ()
    text: str = ""
    commits: Sequence[str] = ()
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
        """Return these results with those entries of ``kept`` that have no newer one here, see ``merged``."""
        old = () if kept is None else kept.entries
        return dataclasses.replace(self, entries=merged(old, self.entries, experiments))


def merged(kept: Sequence[Entry], new: Sequence[Entry], experiments: Sequence[str]) -> tuple[Entry, ...]:
    """Return the entries of ``experiments``, in that order; a ``new`` one replaces a ``kept`` one at the same place."""
    by_place = {entry.place: entry for entry in (*kept, *new)}
    known = [entry for entry in by_place.values() if entry.place[0] in experiments]
    return tuple(sorted(known, key=lambda entry: (experiments.index(str(entry.place[0])), *entry.place[1:])))


def table(entries: Sequence[Entry]) -> str:
    """Return a Markdown table with the columns of all entries, those of the entry with the most columns first.

    Cells that an entry lacks are empty.
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
        UserError: its results are for another ``budget`` (scale), and would be lost if the page were written, or the
            file has other contents.
        ValueError: the file cannot be read as JSON.
    """
    if not file.is_file():
        return {}
    document = read_json(file)
    if not isinstance(document, Mapping) or not {"budget", "rows"} <= set(document):
        raise UserError(f"experiments.page: {file} holds no results of experiments; want another page")
    if not at_scale(document["budget"], budget):
        had, have = scale_of(document["budget"]), scale_of(budget)
        changes = [
            f"budget.{key} was {had[key]} and {f'is {have[key]} now' if key in have else 'is gone'}"
            for key in had
            if had[key] != have.get(key)
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
