"""All methods of an experiment side by side: the paper-style table, AP against images and seconds, what is certain."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from neural_sim.detector.metrics import IN_FULL
from neural_sim.report import figures, logged, tracking
from neural_sim.report.costs import costs, costs_table
from neural_sim.report.curves import curves
from neural_sim.report.finished import FinishedRun, candidates, read_run
from neural_sim.report.intervals import Estimate
from neural_sim.report.page.comparison_page import Section, write_comparison_page
from neural_sim.report.selection import Group, LeftOut, Selection
from neural_sim.report.statistics import ONLY_AT_END, Clock, Comparison, compare


@dataclass(frozen=True)
class Compare:
    """``+experiment=compare``.

    Args:
        experiments: MLflow experiments whose runs are compared, each by itself and at each gap.
        reference: the method that the others are compared with.
        methods: these; null: all that have runs. Seeds are those that all of them have.
        draws: of the bootstrap over test images.
        clock: ``seconds`` on the wall, or ``cpu_seconds``, those of all cores together, for runs that shared a machine.

    Raises:
        ValueError: no experiment, fewer than two draws, or another clock.
    """

    experiments: tuple[str, ...]
    reference: str = "neural_sim"
    draws: int = 300
    clock: Clock = "seconds"
    methods: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if not self.experiments or self.draws < 2:
            raise ValueError(
                f"compare: want experiments and at least 2 draws, got {list(self.experiments)}, {self.draws}"
            )
        if self.clock not in get_args(Clock):
            raise ValueError(f"compare.clock must be one of {get_args(Clock)}, got {self.clock!r}")

    def compare(self, uri: str, seed: int, config: Mapping[str, Any], folder: Path) -> list[Comparison]:
        """Write compare.json, compare.md and the figures to ``folder``, and a run to MLflow.

        Raises:
            ValueError: no such experiment, no run of a named method, or none that can be compared, with the reasons.
        """
        finished = candidates(uri, self.experiments)
        missing = sorted(set(self.methods or ()) - {run.results.get("method") for run in finished})
        if missing:
            raise ValueError(
                f"compare.methods: no run of {', '.join(missing)} in {', '.join(self.experiments)}"
            )
        chosen = Selection(finished, self.reference, self.methods)
        if not chosen.groups:
            why = "; ".join(f"{reason}: {', '.join(runs)}" for reason, runs in by_reason(chosen.left_out))
            raise ValueError(
                f"compare.experiments: no evaluated run of compare.reference={self.reference!r} on biased objects in "
                f"{', '.join(self.experiments)}" + (f" ({why})" if why else "")
            )
        labels = [group.label for group in chosen.groups]
        tags = {"compared": ",".join(labels)}
        with tracking.opened(uri, "compare", ", ".join(labels), tags, tracking.flatten(config)) as tracked:
            comparisons, text, page = self._compared(chosen, seed, folder)
            tracked.log(
                {
                    f"{_slug(c)}/{method}/{c.score.lower()}": c.ap[method].value
                    for c in comparisons
                    for method in c.methods
                }
            )
            tracked.log_files(folder)
        print(text)
        tables = [logged.where_runs(uri, name) for name in dict.fromkeys(self.experiments)]
        lines = dict.fromkeys(line for table in tables for line in table.splitlines())  # one command for all
        print(f"results: {folder}", *lines, f"who is ahead? open {page}", sep="\n")
        return comparisons

    def _compared(self, chosen: Selection, seed: int, folder: Path) -> tuple[list[Comparison], str, Path]:
        """Every group's comparison, with the files in ``folder``; the text of compare.md, and the page."""
        comparisons, parts, documents, sections = [], [], [], []
        for group in chosen.groups:
            runs = [read_run(run) for run in group.runs]
            comparison = compare(runs, self.reference, self.draws, seed, self.clock)
            comparison = dataclasses.replace(comparison, setting=group.label)
            comparisons.append(comparison)
            parts.append(markdown(comparison, runs, group.heading))
            spent = costs(runs)
            document = {"costs": {method: dataclasses.asdict(cost) for method, cost in spent.items()}}
            documents.append(dataclasses.asdict(comparison) | document | _sources(group))
            drawn = curves(comparison, runs)
            figures.save(drawn, folder / "figures" / f"{_slug(comparison)}.png")
            sections.append(Section(comparison, drawn, group.heading, runs[0].results["biased"], spent))
        text = "\n\n".join([*parts, *left_out_table(chosen.left_out)])
        left = [dataclasses.asdict(run) for run in chosen.left_out]
        (folder / "compare.json").write_text(
            json.dumps(plain({"comparisons": documents, "left_out": left}), indent=1, allow_nan=False)
        )
        (folder / "compare.md").write_text(text + "\n")
        page = write_comparison_page(sections, dict(by_reason(chosen.left_out)), folder)
        return comparisons, text, page


def _slug(comparison: Comparison) -> str:
    """The setting as part of a file's or a metric's name."""
    return comparison.setting.replace(", ", "_").replace(" ", "_")


def _sources(group: Group) -> dict[str, Any]:
    """The data of a table, for compare.json."""
    rows = [{"method": r.method, "seed": r.seed, "run": r.name, "run_id": r.run_id} for r in group.runs]
    return {"heading": group.heading, "scoring": group.runs[0].results["scoring"], "runs": rows}


def by_reason(left_out: Sequence[LeftOut]) -> list[tuple[str, list[str]]]:
    """Runs with the first digits of their ids, by why they were left out."""
    grouped: dict[str, list[str]] = {}
    for run in left_out:
        grouped.setdefault(run.reason, []).append(f"{run.run} ({run.run_id[:8]})")
    return list(grouped.items())


def left_out_table(left_out: Sequence[LeftOut]) -> list[str]:
    """A section of compare.md, none where every run was compared."""
    if not left_out:
        return []
    lines = ["## Left out", "", "| runs | why |", "|---|---|"]
    for reason, runs in by_reason(left_out):
        cells = (", ".join(runs), reason)
        lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return ["\n".join(lines)]


def markdown(comparison: Comparison, runs: Sequence[FinishedRun], heading: str = "") -> str:
    """The table of one setting, its differences, the distances of the learned distributions, and costs. ``heading`` is
    how these runs differ from others of the setting.
    """
    c = comparison
    unit = "seconds" if c.clock == "seconds" else "CPU seconds"
    lines = [
        f"## {c.setting}" + (f": {heading}" if heading else ""),
        f"Seed{'s' if c.several else ''} {', '.join(map(str, c.seeds))}; "
        f"{IN_FULL[c.score]} of {', '.join(runs[0].results['biased'])} in points, "
        f"with 95 % intervals over {'seeds and test images' if c.several else 'test images alone'}.",
        *_on_other_devices(runs),
        "",
        f"| method | {c.score} | of the gap closed | {c.reference} ahead by | area ahead by "
        f"| {c.score} after {c.equal_cost:.0f} {unit} | images | detector steps | {unit} |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for bound in c.bounds:
        lines.append(f"| {bound} | {points(c.ap[bound])} | | | | | | | |")
    for method in c.methods:
        ahead = points(c.ahead[method], sure=c.several) if method in c.ahead else ""
        area = points(c.area[method], sure=c.timed) if method in c.area else ""
        won = points(c.won_back[method], "%") if method in c.won_back else ""
        spent = c.spent[method]
        lines.append(
            f"| {method} | {points(c.ap[method])} | {won} | {ahead} | {area} "
            f"| {points(c.at_equal_cost[method])} "
            f"| {spent['images']:.0f} | {spent['detector_steps']:.0f} | {spent[c.clock]:.0f} |"
        )
    bold = "Differences in bold exceed the spread: their interval leaves 0 out. "
    if not c.several:
        bold = "None is in bold: intervals of one seed leave out how much trainings differ. "
    lines += ["", f"{bold}Images, steps and seconds "
              "include the warm start, whose backbone every loop trains on; fields, which all methods share, and the "
              "labelled validation images are not counted. "
              "The fraction closed has no interval where the gap's own includes 0. "
              f"{c.score[0].upper()}{c.score[1:]} at equal seconds: those of the cheapest method, between scored "
              "iterations linear in log seconds.", ""]  # fmt: skip
    lines += [ONLY_AT_END, ""] * c.only_at_end
    return "\n".join([*lines, *_leads(c, unit), *_distances(c, runs), "", costs_table(runs)])


def _leads(c: Comparison, unit: str) -> list[str]:
    """The reference's lead by budget; empty without another method."""
    if not c.ahead_at:
        return []
    head = (
        f"| {c.reference} ahead after so many {unit}, of | "
        + " | ".join(f"{b:.0f}" for b in c.budgets)
        + " |"
    )
    rows = [
        f"| {method} | " + " | ".join(points(lead, sure=c.timed) for lead in leads) + " |"
        for method, leads in c.ahead_at.items()
    ]
    note = f"A method that has ended keeps its last {c.score}; before its first scored iteration it has the start's."
    return [head, "|---|" + "---|" * len(c.budgets), *rows, "", note, ""]


def _on_other_devices(runs: Sequence[FinishedRun]) -> list[str]:
    """A warning where the seconds of a table come from devices of several kinds."""
    kinds: dict[str, list[str]] = {}
    for run in runs:
        kind = run.results["config"]["trainer"]["accelerator"]
        kinds.setdefault(kind, []).append(f"{run.method} seed {run.seed}")
    named = "; ".join(f"{kind}: {', '.join(which)}" for kind, which in kinds.items())
    return ["", f"Seconds are not comparable, the runs were made on devices of several kinds ({named})."] * (
        len(kinds) > 1
    )


def plain(tree: Any) -> Any:
    """NaN as None, so that the file is JSON by the standard."""
    if isinstance(tree, Mapping):
        return {key: plain(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [plain(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def points(estimate: Estimate, unit: str = "", sure: bool = False) -> str:
    """A fraction in percentage points with its interval; with ``sure``, in bold where the interval excludes 0."""
    digits = 0 if unit else 1
    text = _hundredfold(estimate.value, digits) + (f" {unit}" if unit else "")
    if estimate.low is None or estimate.high is None:
        return text
    text = f"**{text}**" if sure and estimate.certain else text
    return f"{text} ({_hundredfold(estimate.low, digits)} to {_hundredfold(estimate.high, digits)})"


def _hundredfold(value: float, digits: int) -> str:
    """In hundredths, never as a negative zero."""
    return f"{100 * value:z.{digits}f}"


def _distances(comparison: Comparison, runs: Sequence[FinishedRun]) -> list[str]:
    """Mean distances of every biased object and factor, before and after; empty where the target is not known."""
    rows = []
    table = {(run.method, run.seed): run.results["total_variation"] for run in runs}
    for name in runs[0].results["biased"]:
        for factor in runs[0].results["total_variation"][name]:
            means = []
            for method in comparison.methods:
                each = [table[method, seed][name][factor] for seed in comparison.seeds]
                means.append({w: sum(row[w] for row in each) / len(each) for w in ("initial", "learned")})
            cells = " | ".join(f"{mean['learned']:.2f}" for mean in means)
            rows.append(f"| {name}, {factor} | {means[0]['initial']:.2f} | {cells} |")
    head = ["| total variation to the target | initial | " + " | ".join(comparison.methods) + " |"]
    head += ["|---|" + "---|" * (1 + len(comparison.methods))]
    return head + rows if rows else []
