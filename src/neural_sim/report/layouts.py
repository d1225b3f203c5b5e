"""What is shown of an experiment's finished runs: lines for the table of experiments, a table of its own, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from neural_sim.report.compare import points
from neural_sim.report.entries import Entry
from neural_sim.report.histograms import histogram_entries, histogram_figure, histograms
from neural_sim.report.levels import Axis, levels_entries, levels_figure
from neural_sim.report.object_scores import MEAN, ObjectScores, called
from neural_sim.report.photographs import photographs_summary, photographs_table
from neural_sim.report.settings import Setting


@dataclass(frozen=True)
class Shown:
    """``lines`` are for the table of all experiments, ``text`` is Markdown below it, ``figures`` are by file name.
    ``entries`` have lines and the rows of a table above the text.
    """

    lines: Sequence[str] = ()
    text: str = ""
    entries: Sequence[Entry] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)


@dataclass(frozen=True)
class Paper:
    """A table of the paper, as conf/paper/numbers.yaml has it: ``rows`` maps a name to a number for each column, None
    where it prints none. ``lines`` are those of its LaTeX source.

    Raises:
        ValueError: a row without a number for each column.
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
        """The table with its title and source."""
        lines = [f"{self.title} (l. {self.lines[0]} to {self.lines[1]}):", ""]
        lines += ["| | " + " | ".join(self.columns) + " |", "|" + "---|" * (1 + len(self.columns))]
        for name, row in self.rows.items():
            cells = ["N/A" if value is None else f"{value:g}" for value in row]
            lines.append("| " + " | ".join([name, *cells]) + " |")
        return "\n".join(lines)


def _levels(axis: Axis) -> Callable[..., Shown]:
    def show(settings: Sequence[Setting], paper: Paper | None) -> Shown:
        figure = levels_figure(settings, axis)
        return Shown(entries=levels_entries(settings, axis), figures={"levels": figure})

    return show


def _histograms(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    found = list(histograms(settings))
    return Shown(entries=histogram_entries(found), figures={"histograms": histogram_figure(found)})


def _objects(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """The paper's Table 1: rows are objects, columns methods, ours and the paper's."""
    lines, parts = [], []
    means = {"AP": MEAN, "accuracy": "mean accuracy"}
    for setting in settings:
        scores, mean = setting.scores, means[setting.runs[0].score]
        ahead = [
            f"{called(method)} by {points(own[MEAN])}"
            for method, own in scores.ahead.items()
            if method != "matched"
        ]
        ours = points(scores.ap[scores.reference][MEAN])
        lines.append(f"{setting.group.label}: {mean} of NSO {ours}; ahead of {', '.join(ahead)}")
        parts.append(
            f"{setting.group.label}, seeds {', '.join(map(str, scores.seeds))}:\n\n"
            + beside(scores, paper, mean)
        )
    return Shown(lines, "\n\n".join(parts))


def _photographs(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """The paper's Table 2: rows are ways of training, columns numbers of photographs, ours and then the paper's."""
    tables = [photographs_table(settings), *([] if paper is None else [paper.markdown()])]
    return Shown(photographs_summary(settings), "\n\n".join(tables))


def beside(scores: ObjectScores, paper: Paper | None, mean: str = MEAN) -> str:
    """The score of every object in points with 95 % intervals, beside the paper's."""
    columns = [] if paper is None else list(paper.columns)
    rows = {} if paper is None else paper.rows
    head = ["", *(f"{called(m)}, ours" for m in scores.methods), *(f"{name}, the paper" for name in columns)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in (MEAN, *scores.objects):
        theirs = rows.get(name, [None] * len(columns))
        cells = [
            mean if name == MEAN else name,
            *(points(scores.ap[method][name]) for method in scores.methods),
        ]
        lines.append("| " + " | ".join([*cells, *("" if v is None else f"{v:g}" for v in theirs)]) + " |")
    return "\n".join(lines)


def _seconds(settings: Sequence[Setting], paper: Paper | None) -> Shown:
    """Wall-clock seconds of the reference method's iterations and of an object's field."""
    lines = []
    for setting in settings:
        iterations = [_iteration(record) for run in setting.of_reference for record in run["iterations"]]
        fields = [_field(run) for run in setting.of_reference]
        lines.append(
            f"{setting.group.label}: an iteration takes {_range(iterations)} s, an object's field {_range(fields)} s"
        )
    return Shown(lines)


def _iteration(record: Mapping[str, Any]) -> float:
    """Phases ``hypergradient_*`` are parts of ``hypergradient``."""
    return sum(s for phase, s in record["seconds"].items() if not phase.startswith("hypergradient_"))


def _field(run: Mapping[str, Any]) -> float:
    """Of one object on average, also where the store had it: then the seconds that it took when it was fitted."""
    stored = [o["seconds"] for o in run["left_out"] if o["stage"] == "field" and o["seconds"] is not None]
    return (run["seconds"]["field"] + sum(stored)) / len(run["psi"])


def _range(values: Sequence[float]) -> str:
    """The median, and the range if there is one: first iterations take two trainings more than last ones."""
    low, middle, high = (f"{value:.1f}" for value in (min(values), median(values), max(values)))
    return low if low == high else f"{middle} ({low} to {high})"


LAYOUTS: Mapping[str, Callable[[Sequence[Setting], Paper | None], Shown]] = {
    "gaps": _levels("gap"),
    "targets": _levels("target"),
    "objects": _objects,
    "histograms": _histograms,
    "photographs": _photographs,
    "seconds": _seconds,
}
"""By the name that a row of ``experiments.rows`` gives."""
