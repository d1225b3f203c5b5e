"""Layouts of the results of finished runs: lines for the table of experiments, tables below it, and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from neural_sim.documents import markdown_table
from neural_sim.report.figures import Figure
from neural_sim.report.intervals import points
from neural_sim.studies.experiments.charts import (
    Axis,
    histogram_entries,
    histogram_figure,
    histograms,
    levels_entries,
    levels_figure,
)
from neural_sim.studies.experiments.results import MEAN, Measured, Setting, called

Shown = tuple[Measured, Mapping[str, Figure]]
"""A layout's tables of some settings, without commits and costs, and its figures by file name."""
Layout = Callable[[Sequence[Setting], "Paper | None"], Shown]
NONE = "none"
WAYS = {NONE: "synthetic alone", "pretrain": "synthetic, then photographs", "combined": "both together"}
"""Ways of training with photographs, by ``training.real.mode``, in the order of table rows."""
ALONE = {"real_only": "photographs alone", "views_only": "views of the fields alone"}
"""Detectors trained without synthetic images, whose rows come first in a table."""


@dataclass(frozen=True)
class Paper:
    """A table of the paper, from conf/paper/numbers.yaml.

    Args:
        title: title of the table in the paper.
        lines: first and last line in the LaTeX source of the paper.
        columns: titles of the columns.
        rows: one number per column by name of the row, None where the paper prints none.

    Raises:
        ValueError: a row does not have one number per column.
    """

    title: str
    lines: tuple[int, int]
    columns: Sequence[str]
    rows: Mapping[str, Sequence[float | None]]

    def __post_init__(self) -> None:
        short = [name for name, row in self.rows.items() if len(row) != len(self.columns)]
        if short or not self.rows:
            raise ValueError(f"{self.title}: want a number for each of {list(self.columns)} in rows {short}")

    def markdown(self) -> str:
        """Return the table with its title and source."""
        rows = [
            [name, *("N/A" if value is None else f"{value:g}" for value in row)]
            for name, row in self.rows.items()
        ]
        title = f"{self.title} (l. {self.lines[0]} to {self.lines[1]}):"
        return f"{title}\n\n{markdown_table(['', *self.columns], rows)}"


def _levels(axis: Axis) -> Layout:
    def show(settings: Sequence[Setting], paper: Paper | None) -> Shown:
        entries = levels_entries(settings, axis)
        return Measured(entries=entries), {"levels": levels_figure(settings, axis)}

    return show


def _histograms(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    found = list(histograms(settings))
    return Measured(entries=histogram_entries(found)), {"histograms": histogram_figure(found)}


def _objects(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """Show our scores next to those of the paper's Table 1: rows are objects, columns are methods."""
    lines, parts = [], []
    means = {"AP": MEAN, "accuracy": "mean accuracy"}
    for setting in settings:
        label, mean = setting.group.label, means[setting.first.score]
        lines.append(f"{label}, {mean}: {setting.verdict()}")
        parts.append(f"{label}, seeds {setting.seeds}:\n\n{objects_table(setting, paper, mean)}")
    return Measured(lines, "\n\n".join(parts)), {}


def objects_table(setting: Setting, paper: Paper | None, mean: str = MEAN) -> str:
    """Return a table of the scores of all objects in points, with 95 % intervals and the paper's numbers."""
    columns = [] if paper is None else list(paper.columns)
    theirs = {} if paper is None else paper.rows
    head = ["", *(f"{called(m)}, ours" for m in setting.methods), *(f"{name}, the paper" for name in columns)]
    rows = []
    for name in (MEAN, *setting.objects):
        ours = [points(setting.score(method, name)) for method in setting.methods]
        papers = ["" if v is None else f"{v:g}" for v in theirs.get(name, [None] * len(columns))]
        rows.append([mean if name == MEAN else name, *ours, *papers])
    return markdown_table(head, rows)


def _photographs(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """Show our scores next to the paper's Table 2: rows are ways of training, columns are numbers of photographs."""
    tables = [photographs_table(settings), *([] if paper is None else [paper.markdown()])]
    return Measured(photographs_summary(settings), "\n\n".join(tables)), {}


def asked(setting: Setting) -> tuple[float, str]:
    """Return how many photographs a setting asks for, as a number to sort by and in words.

    The words have the configured number or fraction. The number that was used follows in brackets if it differs.
    """
    real = setting.first.results["config"]["training"]["real"]
    trained = [run.results["real"].get("photographs", 0) for run in setting.group.runs]
    fewest, most = min(trained), max(trained)
    used = f"{most}" if fewest == most else f"{fewest} to {most}"
    if real["count"] is not None:
        fewer = f" ({used} at hand)" if fewest < real["count"] else ""
        return real["count"], f"{real['count']} photographs{fewer}"
    fraction = 1.0 if real["fraction"] is None else real["fraction"]
    return fraction, f"{100 * fraction:g} % of the photographs ({used})"


def photographs_table(settings: Sequence[Setting]) -> str:
    """Return a table of the mean score of the biased objects in points, with 95 % intervals."""
    columns = [text for _, text in sorted({asked(setting) for setting in settings})]
    rows: dict[str, dict[str, str]] = {}
    for setting in sorted(settings, key=_rank):
        number = asked(setting)[1]
        names = {which: row for which, row in ALONE.items() if which in setting.columns}
        names |= {m: f"{WAYS[_mode(setting)]}, {called(m)}" for m in setting.methods if m != "matched"}
        for detector, row in names.items():
            rows.setdefault(row, {})[number] = points(setting.score(detector))
    order = sorted(rows, key=lambda row: row not in ALONE.values())
    return markdown_table(
        ["mAP", *columns], [[name, *(rows[name].get(text, "") for text in columns)] for name in order]
    )


def _rank(setting: Setting) -> tuple[int, int]:
    """Return a sort key: by mode, and by number of methods, so that the first setting fixes the order of the rows."""
    return list(WAYS).index(_mode(setting)), -len(setting.methods)


def _mode(setting: Setting) -> str:
    """Return the mode of training on photographs; ``none`` also if there were none."""
    return setting.first.results["real"].get("mode", NONE)


def photographs_summary(settings: Sequence[Setting]) -> list[str]:
    """Return the reference's score and leads, and the score of photographs alone, for each setting."""
    lines = []
    for setting in sorted(settings, key=asked):
        known = "real_only" in setting.columns
        alone = f"; photographs alone {points(setting.score('real_only'))}" if known else ""
        where = f"{asked(setting)[1]}, {WAYS[_mode(setting)]}, seeds {setting.seeds}"
        lines.append(f"{where}: {setting.verdict()}{alone}")
    return lines


def _seconds(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """Say how many seconds the reference method's iterations and an object's field take."""
    lines = []
    for setting in settings:
        iterations = [_iteration(record) for run in setting.of_reference for record in run["iterations"]]
        fields = [_field(run) for run in setting.of_reference]
        lines.append(
            f"{setting.group.label}: an iteration takes {_range(iterations)} s, an object's field {_range(fields)} s"
        )
    return Measured(lines), {}


def _iteration(record: Mapping[str, Any]) -> float:
    """Return the seconds of an iteration; phases ``hypergradient_*`` are parts of ``hypergradient``, counted once."""
    return sum(s for phase, s in record["seconds"].items() if not phase.startswith("hypergradient_"))


def _field(run: Mapping[str, Any]) -> float:
    """Return the mean seconds per field; one that was read from the store counts with the time that its fit took."""
    stored = [o["seconds"] for o in run["left_out"] if o["stage"] == "field" and o["seconds"] is not None]
    return (run["seconds"]["field"] + sum(stored)) / len(run["psi"])


def _range(values: Sequence[float]) -> str:
    """Write the median, and the range if values differ, as those of iterations with different trainings do."""
    low, middle, high = (f"{value:.1f}" for value in (min(values), median(values), max(values)))
    return low if low == high else f"{middle} ({low} to {high})"


LAYOUTS: Mapping[str, Layout] = {
    "gaps": _levels("gap"),
    "targets": _levels("target"),
    "objects": _objects,
    "histograms": _histograms,
    "photographs": _photographs,
    "seconds": _seconds,
}
"""Layouts by name, as in ``experiments.rows``."""
