"""``+experiment=compare``: compare the methods of experiments by their finished runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, MinLen
from typing_extensions import override

from neural_sim.detector.metrics import IN_FULL
from neural_sim.documents import markdown_table, write_whole
from neural_sim.ranges import validated
from neural_sim.report import figures, tracking
from neural_sim.report.comparison import (
    HEAD,
    NOTE,
    ONLY_AT_END,
    Clock,
    Comparison,
    Costs,
    biased_ap,
    cells,
    compare,
    costs,
    costs_table,
)
from neural_sim.report.figures import Figure
from neural_sim.report.intervals import bounds, points
from neural_sim.report.page import render
from neural_sim.report.page.verdict import POINTS, listed
from neural_sim.report.provenance import caution
from neural_sim.report.runs import FinishedRun, Group, LeftOut, Runs, by_reason, select
from neural_sim.tasks.context import Context, Task

UNITS = {"images": "images", "seconds": "seconds", "cpu_seconds": "seconds of processor time"}


@validated
@dataclass(frozen=True)
class Compare(Task):
    """Compare finished runs of MLflow experiments, separately for each experiment and gap.

    Writes compare.md, compare.json, figures and report.html to the run's folder, and logs a run to MLflow.

    Args:
        experiments: MLflow experiments whose runs are compared.
        reference: the method that the others are compared with.
        draws: bootstrap draws over test images.
        clock: ``seconds`` of wall-clock time, or ``cpu_seconds`` of all cores together, for runs that shared a machine.
        methods: methods to compare; null: all that have runs. Only the seeds that all of them have are used.
    """

    experiments: Annotated[tuple[str, ...], MinLen(1)]
    reference: str = "neural_sim"
    draws: Annotated[int, Ge(2)] = 300
    clock: Clock = "seconds"
    methods: tuple[str, ...] | None = None

    @override
    def run(self, context: Context) -> None:
        groups, left_out = self.selected(Runs.read(context.uri, self.experiments))
        tables = [self.table(group, context.config["seed"]) for group in groups]
        page = write_page(tables, left_out, context.folder)
        labels = [table.group.label for table in tables]
        context.publish(
            "compare",
            {
                "comparisons": [table.document for table in tables],
                "left_out": [dataclasses.asdict(run) for run in left_out],
            },
            compare_markdown(tables, left_out),
            {table.slug: table.figure for table in tables},
            {name: value for table in tables for name, value in table.metrics.items()},
            tags={"compared": ",".join(labels)},
            title=", ".join(labels),
        )
        shown = [tracking.where_runs(context.uri, name) for name in dict.fromkeys(self.experiments)]
        lines = dict.fromkeys(line for where in shown for line in where.splitlines())  # one command for all
        print(*lines, f"who is ahead? open {page}", sep="\n")

    def selected(self, runs: Runs) -> tuple[list[Group], tuple[LeftOut, ...]]:
        """Return the groups of runs to compare, and the runs that are left out.

        Raises:
            ValueError: a method in ``methods`` has no run, or no run can be compared; the message has the reasons.
        """
        known = {run.results.get("method") for run in runs.rows}
        missing = sorted(set(self.methods or ()) - known)
        names = ", ".join(self.experiments)
        if missing:
            raise ValueError(f"compare.methods: no run of {', '.join(missing)} in {names}")
        groups, left_out = select(runs, self.reference, self.methods)
        if not groups:
            why = "; ".join(
                f"{reason}: {', '.join(labels)}" for reason, labels in by_reason(left_out).items()
            )
            raise ValueError(
                f"compare.experiments: no evaluated run of compare.reference={self.reference!r} on biased objects in "
                f"{names}" + (f" ({why})" if why else "")
            )
        return groups, left_out

    def table(self, group: Group, seed: int) -> Table:
        """Compare the runs of one group; ``seed`` seeds the bootstrap."""
        comparison = compare(group.runs, self.reference, self.draws, seed, self.clock)
        return Table(group, dataclasses.replace(comparison, setting=group.label), costs(group.runs))


@dataclass(frozen=True)
class Table:
    """The comparison of one group of runs: a section of compare.md and of the page, and an entry of compare.json."""

    group: Group
    comparison: Comparison
    costs: Mapping[str, Costs]

    cost_head = HEAD
    cost_note = NOTE

    @property
    def slug(self) -> str:
        """The group's label as a part of names of files and metrics."""
        return self.group.label.replace(", ", "_").replace(" ", "_")

    @property
    def biased(self) -> Sequence[str]:
        """The objects whose scores are compared."""
        return self.group.runs[0].results["biased"]

    @property
    def document(self) -> dict[str, Any]:
        """The entry of the group in compare.json."""
        runs = self.group.runs
        return {
            **dataclasses.asdict(self.comparison),
            "costs": {method: dataclasses.asdict(cost) for method, cost in self.costs.items()},
            "heading": self.group.heading,
            "scoring": runs[0].results["scoring"],
            "runs": [
                {"method": run.method, "seed": run.seed, "run": run.name, "run_id": run.run_id}
                for run in runs
            ],
        }

    @property
    def metrics(self) -> dict[str, float]:
        """Scores of the methods, by MLflow metric name."""
        c = self.comparison
        return {f"{self.slug}/{method}/{c.score.lower()}": c.ap[method].value for method in c.methods}

    @cached_property
    def figure(self) -> Figure:
        """Scores against images and seconds."""
        return curves(self.comparison, self.group.runs)

    @property
    def chart(self) -> str:
        """The figure as the source of an ``<img>``."""
        return render.data_uri(self.figure)

    @property
    def cost_rows(self) -> dict[str, list[str]]:
        """Cells by method, under ``cost_head``."""
        return {method: cells(cost) for method, cost in self.costs.items()}

    @property
    def verdict(self) -> str:
        """One sentence that says which methods the reference is ahead of, and which not."""
        return verdict(self.comparison)

    @property
    def warning(self) -> str:
        """A warning that scores at smaller budgets do not show which method leads; empty if they do."""
        return ONLY_AT_END if self.comparison.only_at_end else ""

    @property
    def cautions(self) -> list[str]:
        """Warnings to put before the scores."""
        return cautions(self.group.runs)

    @property
    def in_full(self) -> str:
        """The full name of the score."""
        return IN_FULL[self.comparison.score]

    @property
    def longest(self) -> float:
        """The largest score in the table, which sets the scale of the bars."""
        return max((estimate.value for estimate in self.comparison.ap.values()), default=1.0) or 1.0


def compare_markdown(tables: Sequence[Table], left_out: Sequence[LeftOut]) -> str:
    """Return the text of compare.md."""
    parts = [markdown(table.comparison, table.group.runs, table.group.heading) for table in tables]
    return "\n\n".join([*parts, *left_out_table(left_out)])


def left_out_table(left_out: Sequence[LeftOut]) -> list[str]:
    """Return the section on runs that were left out, in a list; empty if there are none."""
    if not left_out:
        return []
    rows = [(", ".join(runs), reason.replace("\n", " ")) for reason, runs in by_reason(left_out).items()]
    return ["## Left out\n\n" + markdown_table(["runs", "why"], rows)]


def markdown(comparison: Comparison, runs: Sequence[FinishedRun], heading: str = "") -> str:
    """Return the scores and leads of one group, the distances of the learned distributions, and the costs.

    Args:
        comparison: comparison of the runs.
        runs: one run of each method at each seed.
        heading: how these runs differ from others of the setting.
    """
    c = comparison
    bold = "Differences in bold exceed the spread: their interval excludes 0. "
    if not c.several:
        bold = "None is in bold: intervals of one seed leave out how much trainings differ. "
    parts = [
        f"## {c.setting}" + (f": {heading}" if heading else "") + "\n"
        f"Seed{'s' if c.several else ''} {', '.join(map(str, c.seeds))}; "
        f"{IN_FULL[c.score]} of {', '.join(runs[0].results['biased'])} in points, "
        f"with 95 % intervals over {'seeds and test images' if c.several else 'test images alone'}.",
        *cautions(runs),
        *_on_other_devices(runs),
        _scores_table(c),
        f"{bold}Images, steps and seconds include the warm start, whose backbone every loop trains on; fields, which "
        "all methods share, and the labelled validation images are not counted. "
        "The fraction of the gap that is closed has no interval if the gap's own interval includes 0. "
        f"The {c.score} after {c.equal_cost:.0f} {_unit(c)}, the time of the cheapest method, is interpolated between "
        "scored iterations, linearly in log seconds.",
        *[ONLY_AT_END] * c.only_at_end,
        *_leads(c),
        *_distances(c, runs),
        costs_table(runs),
    ]
    return "\n\n".join(parts)


def _unit(comparison: Comparison) -> str:
    return "seconds" if comparison.clock == "seconds" else "CPU seconds"


def _scores_table(c: Comparison) -> str:
    unit = _unit(c)
    head = [
        "method", c.score, "of the gap closed", f"{c.reference} ahead by", "area ahead by",
        f"{c.score} after {c.equal_cost:.0f} {unit}", "images", "detector steps", unit,
    ]  # fmt: skip
    rows = [[bound, points(c.ap[bound]), *[""] * (len(head) - 2)] for bound in c.bounds]
    for method in c.methods:
        spent = [f"{c.spent[method][key]:.0f}" for key in ("images", "detector_steps", c.clock)]
        rows.append(
            [
                method,
                points(c.ap[method]),
                points(c.won_back[method], "%") if method in c.won_back else "",
                points(c.ahead[method], sure=c.several) if method in c.ahead else "",
                points(c.area[method], sure=c.timed) if method in c.area else "",
                points(c.at_equal_cost[method]),
                *spent,
            ]
        )
    return markdown_table(head, rows)


def _leads(c: Comparison) -> list[str]:
    """Return a table of the reference's lead by budget, with a note; nothing if there is no other method."""
    if not c.ahead_at:
        return []
    head = [f"{c.reference} ahead after ({_unit(c)}), of", *(f"{budget:.0f}" for budget in c.budgets)]
    rows = [[method, *(points(lead, sure=c.timed) for lead in leads)] for method, leads in c.ahead_at.items()]
    note = f"A method that has ended keeps its last {c.score}; until its first scored iteration, it has its start's."
    return [markdown_table(head, rows), note]


def cautions(runs: Sequence[FinishedRun]) -> list[str]:
    """Return warnings to put before the scores, for runs at a scale at which scores mean nothing."""
    scales = dict.fromkeys(run.results.get("scale", "") for run in runs)
    return [said for scale in scales if (said := caution(scale))]


def _on_other_devices(runs: Sequence[FinishedRun]) -> list[str]:
    """Return a warning, in a list, if the runs were made on different kinds of devices."""
    kinds: dict[str, list[str]] = {}
    for run in runs:
        kind = run.results["config"]["trainer"]["accelerator"]
        kinds.setdefault(kind, []).append(f"{run.method} seed {run.seed}")
    if len(kinds) == 1:
        return []
    named = "; ".join(f"{kind}: {', '.join(which)}" for kind, which in kinds.items())
    return [
        f"Seconds are not comparable, because the runs were made on different kinds of devices ({named})."
    ]


def _distances(comparison: Comparison, runs: Sequence[FinishedRun]) -> list[str]:
    """Return a table of mean distances by biased object and factor; no table if the target is unknown."""
    rows = []
    table = {(run.method, run.seed): run.results["total_variation"] for run in runs}
    for name in runs[0].results["biased"]:
        for factor in runs[0].results["total_variation"][name]:
            means = []
            for method in comparison.methods:
                each = [table[method, seed][name][factor] for seed in comparison.seeds]
                means.append({w: sum(row[w] for row in each) / len(each) for w in ("initial", "learned")})
            learned = [f"{mean['learned']:.2f}" for mean in means]
            rows.append([f"{name}, {factor}", f"{means[0]['initial']:.2f}", *learned])
    head = ["total variation to the target", "initial", *comparison.methods]
    return [markdown_table(head, rows)] if rows else []


def curves(comparison: Comparison, runs: Sequence[FinishedRun]) -> Figure:
    """Draw the score of the biased objects against images and against seconds, one line per seed."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    figures.titled(figure, comparison.setting)
    for place, key in enumerate(("images", comparison.clock), 1):
        axes = figure.add_subplot(1, 2, place)
        for number, method in enumerate(comparison.methods):
            colour = figures.CLASS_COLOURS[number % len(figures.CLASS_COLOURS)]
            for line, run in enumerate(run for run in runs if run.method == method):
                spent = [point[key] for point in run.results["curve"]]
                # Steps show the score that a method has reached so far; areas, in contrast, interpolate it linearly
                # in log seconds.
                axes.plot(
                    spent, 100 * biased_ap(run, comparison.clock)[1], ".-", drawstyle="steps-post", color=colour,
                    alpha=0.7, linewidth=1, label=method if line == 0 else None,
                )  # fmt: skip
        for bound, style in zip(comparison.bounds, (":", "--"), strict=False):
            axes.axhline(100 * comparison.ap[bound].value, color=figures.MUTED, linestyle=style, linewidth=1)
            axes.annotate(bound, (1.0, 100 * comparison.ap[bound].value), xycoords=("axes fraction", "data"),
                          ha="right", va="bottom", fontsize=7, color=figures.MUTED)  # fmt: skip
        # The start has zero cost, which a logarithmic axis would not show.
        least = [point[key] for run in runs for point in run.results["curve"] if point[key] > 0]
        axes.set_xscale("symlog", linthresh=min(least, default=1))
        label = f"{comparison.score} of the biased objects (%)"
        axes.set(xlabel=f"{UNITS[key]} (log)", ylabel=label, xlim=(0, None))
        axes.grid(color=figures.GRID)
        figures.style(axes)
        handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside right upper", fontsize=8, frameon=False)
    return figure


def verdict(comparison: Comparison) -> str:
    """Say which methods the reference is ahead of or behind in final score, and which it cannot be told apart from.

    For a single seed, it adds that the intervals do not include the scatter between trainings.
    """
    c = comparison
    reached = c.ap[c.reference]
    parts = [f"{c.reference} reaches {100 * reached.value:.1f} {POINTS[c.score]} ({bounds(reached)})"]
    for word, sign in (("ahead of", 1.0), ("behind", -1.0)):
        methods = [method for method, lead in c.ahead.items() if lead.certain and sign * lead.value > 0.0]
        if methods:
            parts.append(f"{word} " + listed([f"{m} by {abs(100 * c.ahead[m].value):.1f}" for m in methods]))
    untold = [method for method, lead in c.ahead.items() if not lead.certain]
    if untold:
        parts.append(f"not told apart from {listed(untold)}")
    one = "; from one seed, whose intervals leave out how much trainings differ" if not c.several else ""
    return ", ".join(parts) + one + "."


def write_page(tables: Sequence[Table], left_out: Sequence[LeftOut], folder: Path) -> Path:
    """Write report.html: who is ahead, by how much, at what cost."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "report.html"
    title = "Comparison: " + ", ".join(table.group.label for table in tables)
    text = render.page("comparison.html", title=title, sections=tables, left_out=by_reason(left_out))
    return write_whole(path, text)
