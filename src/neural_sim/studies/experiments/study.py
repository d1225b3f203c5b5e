"""The page of all experiments: the command of each, the results of its finished runs, and the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge
from typing_extensions import override

from neural_sim.configuration import conf_directory
from neural_sim.documents import markdown_table, write_json, write_whole
from neural_sim.ranges import validated
from neural_sim.report import figures
from neural_sim.report.comparison import costs_table
from neural_sim.report.runs import LeftOut
from neural_sim.studies.compare import left_out_table
from neural_sim.studies.experiments.layouts import LAYOUTS, Paper
from neural_sim.studies.experiments.results import (
    Measured,
    Settings,
    document_of,
    newest_document,
    read_measured,
    write_measured,
)
from neural_sim.tasks.context import Context, Task

NOT_YET = "not yet measured"
BY_FIGURES = "figures in the run's folder"
IN_JSON = "All tables, and what the methods cost, are on the site (`nox -s docs`), from `experiments.json`."
COMMAND = "python -m src.main +experiment=experiments_table experiments.page=docs/experiments.md"


@dataclass(frozen=True)
class Row:
    """One experiment on the page.

    Args:
        title: what the paper calls it, and the section.
        experiment: name of its file in conf/experiment; a row without its file is left out.
        runs: the MLflow experiments that have its runs.
        layout: how the runs are shown, one of ``LAYOUTS``; null: by the ``document`` that they wrote.
        document: a Markdown file that its runs write; the newest is shown. Null: there are only figures.
        command: command that runs it; null: ``python -m src.main +experiment=<experiment>``.
        claims: entries of the paper's ``claims``.
        table: the paper's table to show next to ours.
        differs: how its setting differs from the paper's.
        needs: data that it needs and the project does not ship; the page names them if there are no runs.
        elsewhere: where the documentation's page sends readers for our numbers; empty: it gives them itself.

    Raises:
        ValueError: the layout is unknown, has no runs, or is given together with a document.
    """

    title: str
    experiment: str
    runs: Sequence[str] = ()
    layout: str | None = None
    document: str | None = None
    command: str | None = None
    claims: Sequence[str] = ()
    table: str | None = None
    differs: str = ""
    needs: str = ""
    elsewhere: str = ""

    def __post_init__(self) -> None:
        if self.layout is not None and (self.layout not in LAYOUTS or not self.runs or self.document):
            raise ValueError(
                f"experiments.rows, {self.experiment}: want runs and a layout of {', '.join(LAYOUTS)}, or a "
                f"document, got {self.layout!r}, {list(self.runs)} and {self.document!r}"
            )

    @property
    def exists(self) -> bool:
        """Whether its file exists in conf/experiment."""
        return (conf_directory() / "experiment" / f"{self.experiment}.yaml").is_file()

    @property
    def without_runs(self) -> str:
        """The text in place of our numbers if there are no runs."""
        if not self.runs and not self.document:
            return BY_FIGURES
        return f"{NOT_YET}, needs {self.needs}" if self.needs else NOT_YET

    @property
    def command_line(self) -> str:
        """The command that runs the experiment."""
        return self.command or f"python -m src.main +experiment={self.experiment}"


@validated
@dataclass(frozen=True)
class Experiments(Task):
    """``+experiment=experiments_table``: write the page of experiments.

    Args:
        rows: constructor arguments of each ``Row``, by row name.
        paper: ``claims`` and ``tables`` of conf/paper/numbers.yaml.
        only: names of the rows whose runs are read; null: all.
        page: a second place to write the page to, with all rows; null: none.
        reference: the method that the others are compared with.
        draws: bootstrap draws over test images.

    Raises:
        ValueError: a row, claim or table is unknown.
    """

    rows: Mapping[str, Mapping[str, Any]]
    paper: Mapping[str, Mapping[str, Any]]
    only: Sequence[str] | None = None
    page: str | None = None
    reference: str = "neural_sim"
    draws: Annotated[int, Ge(2)] = 300

    def __post_init__(self) -> None:
        unknown = sorted(set(self.only or ()) - set(self.rows))
        if unknown:
            raise ValueError(f"experiments.only: no row {unknown}, want some of {', '.join(self.rows)}")
        for row in self._rows.values():
            missing = [c for c in row.claims if c not in self.paper["claims"]]
            missing += [t for t in (row.table,) if t is not None and t not in self.paper["tables"]]
            if missing:
                raise ValueError(f"experiments.rows, {row.experiment}: the paper's numbers have no {missing}")
        _ = self._tables

    @cached_property
    def _rows(self) -> dict[str, Row]:
        return {name: Row(**arguments) for name, arguments in self.rows.items()}

    @cached_property
    def _tables(self) -> dict[str, Paper]:
        return {name: Paper(**table) for name, table in self.paper["tables"].items()}

    @override
    def run(self, context: Context) -> None:
        print(self.write(context.uri, context.config, context.folder))
        print(f"results: {context.folder}")

    def write(self, uri: str, config: Mapping[str, Any], folder: Path) -> str:
        """Write experiments.md, experiments.json and figures, and the page if asked for.

        The page is short; results by setting and object, and costs, are in the JSON file of the same name. Experiments
        and settings without runs here keep their previous results, which are read from that file.

        Args:
            uri: address of the MLflow store.
            config: the configuration; only runs with the same ``budget`` count, and ``seed`` seeds the bootstrap.
            folder: output folder.

        Returns:
            The text of experiments.md.
        """
        budget = config["budget"]
        settings = Settings(uri, budget, self.reference, self.draws, config["seed"])
        rows = {name: row for name, row in self._rows.items() if row.exists}
        asked = {name: row for name, row in rows.items() if self.only is None or name in self.only}
        kept = {} if self.page is None else read_measured(document_of(self.page), budget)
        found = {name: self._found(row, settings) for name, row in asked.items()}
        for name, (_, shown, _) in found.items():
            for called, figure in shown.items():
                figures.save(figure, folder / "figures" / f"{name}_{called}.png")
        made = {name: measured.with_kept(kept.get(name), rows[name].runs)
                for name, (measured, _, _) in found.items() if measured is not None}  # fmt: skip
        lost = list(dict.fromkeys(run for _, _, left in found.values() for run in left))
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "left_out.md", "\n".join(left_out_table(lost)) + "\n")
        data = {name: {"command": row.command_line, "ours": made[name].summary if name in made else None}
                for name, row in asked.items()}  # fmt: skip
        write_json(folder / "experiments.json", {"rows": data, "left_out": [asdict(run) for run in lost]})
        if self.page is None:
            text = self._page(asked, made, budget)
        else:
            made = {name: own for name, own in {**kept, **made}.items() if name in rows}
            text = self._page(rows, made, budget)
            write_measured(document_of(self.page), budget, made)
            write_whole(Path(self.page), self._brief(rows, made, budget))
        write_whole(folder / "experiments.md", text)
        return text

    def _found(
        self, row: Row, settings: Settings
    ) -> tuple[Measured | None, Mapping[str, Any], list[LeftOut]]:
        """Return the results of finished runs, None if there are none, figures by name, and runs that do not count."""
        if row.document is not None:
            return newest_document(settings.uri, row.experiment, row.document, settings.budget), {}, []
        if row.layout is None:
            return None, {}, []
        found, left_out = settings.read(row.runs)
        if not found:
            return None, {}, left_out
        table = self._tables.get(row.table) if row.table else None
        measured, shown = LAYOUTS[row.layout](found, table)
        runs = [run for setting in found for run in setting.group.runs]
        commits = sorted({commit for setting in found for commit in setting.commits})
        return replace(measured, commits=commits, costs=costs_table(runs)), shown, left_out

    def _head(self, budget: Mapping[str, Any]) -> list[str]:
        views, training, outer = budget["views"], budget["training"], budget["outer"]
        note = (
            f"Ours: runs with {views['count']} views of {views['image_size']} pixels per object, detectors at "
            f"{training['image_size']} pixels and {outer['iterations']} iterations. AP is 0.50 to 0.95 on the test "
            "set, in points. Brackets are 95 % intervals over seeds and test images; those of a single seed are too "
            "narrow (docs/results.md, The same training again). NS is no optimisation, NSO is `baseline=neural_sim` "
            "at a row's commit, which before 3490cc4 was today's `neural_sim_derivative`. "
            "Line numbers are those of the paper's LaTeX source."
        )
        written = (
            f"Written by `{COMMAND}` from finished runs in MLflow; do not edit. Experiments without runs there keep "
            "their last results."
        )
        return ["# Experiments", written, note]

    def _brief(self, rows: Mapping[str, Row], made: Mapping[str, Measured], budget: Mapping[str, Any]) -> str:
        """Return one section per row with its command, the paper's numbers, ours, and the differences."""
        parts = [*self._head(budget), IN_JSON]
        for name, row in rows.items():
            own = made.get(name)
            said = [("The paper", self._claims(row))]
            if own is None:
                said.append(("Ours", [row.without_runs]))
            else:
                lines = [row.elsewhere] if row.elsewhere else own.summary
                said.append((f"Ours, commit {', '.join(own.all_commits)}", lines))
            said.append(("What differs", [row.differs] if row.differs else []))
            points = [_point(title, lines) for title, lines in said if lines]
            parts += [f"## {row.title}", f"    {row.command_line}", "\n".join(points)]
            if own and row.layout is None and not row.elsewhere:
                parts.append(_to_first_table(own.below))
            if row.table and not (own and row.layout):
                parts.append(self._tables[row.table].markdown())
        return "\n\n".join(parts) + "\n"

    def _page(self, rows: Mapping[str, Row], made: Mapping[str, Measured], budget: Mapping[str, Any]) -> str:
        cells = [
            [
                row.title,
                f"`{row.command_line}`",
                made[name].cell if name in made else row.without_runs,
                "<br>".join(self._claims(row)),
                row.differs,
            ]
            for name, row in rows.items()
        ]
        parts = [
            *self._head(budget),
            markdown_table(["the paper's experiment", "command", "ours", "the paper", "what differs"], cells),
        ]
        for name, row in rows.items():
            below = [made[name].below] if name in made and made[name].below else []
            # Layouts show the paper's table themselves.
            if row.table and not (below and row.layout):
                below.append(self._tables[row.table].markdown())
            if below:
                parts += [f"## {name.replace('_', ' ')}", f"{row.title}.", *below]
        used = {row.table for row in rows.values()}
        others = [table for name, table in self._tables.items() if name not in used]
        if others and set(rows) >= {name for name, row in self._rows.items() if row.exists}:
            parts += ["## Tables of the paper without an experiment here"]
            parts += [table.markdown() for table in others]
        return "\n\n".join(parts) + "\n"

    def _claims(self, row: Row) -> list[str]:
        """Return the paper's claims with their sources."""
        found = [claim for name in row.claims for claim in self.paper["claims"][name]]
        sources: dict[str, list[str]] = {}
        for claim in found:
            said = sources.setdefault(f"({claim['source']}, l. {claim['line']})", [])
            said.append(f"{claim['what']} {claim['value']}")
        texts = [f"{'; '.join(said)} {source}" for source, said in sources.items()]
        if row.table:
            texts.append(f"{self._tables[row.table].title}: below")
        return texts


def _point(title: str, lines: Sequence[str]) -> str:
    """Format an item of a list; several lines become nested items."""
    if len(lines) == 1:
        return f"- **{title}**: {lines[0]}"
    return "\n".join([f"- **{title}**:", *(f"    - {line}" for line in lines)])


def _to_first_table(text: str) -> str:
    """Return the paragraphs of a document up to and including its first table, or all if it has none."""
    parts = text.split("\n\n")
    first = next((number for number, part in enumerate(parts) if part.startswith("|")), len(parts))
    return "\n\n".join(parts[: first + 1])
