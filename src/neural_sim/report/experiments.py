"""The page of all experiments: for each its command, what its finished runs gave, and what the paper has."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neural_sim.configuration import conf_directory
from neural_sim.report import figures
from neural_sim.report.compare import left_out_table
from neural_sim.report.costs import costs_table
from neural_sim.report.layouts import LAYOUTS, Paper, Shown
from neural_sim.report.selection import LeftOut
from neural_sim.report.settings import Settings

NOT_YET = "not yet measured"
COMMAND = "python -m src.main +experiment=experiments_table experiments.page=docs/experiments.md"


@dataclass(frozen=True)
class Row:
    """One experiment of the page.

    Args:
        title: what the paper calls it, and where.
        experiment: the file in conf/experiment; a row without its file is left out.
        runs: the MLflow experiments of its runs.
        layout: how they are shown, one of ``LAYOUTS``; null: by the run's own report.
        command: what runs it; null: ``python -m src.main +experiment=<experiment>``.
        claims: entries of the paper's ``claims``.
        table: the paper's table that stands beside ours.
        differs: what differs from the paper's setting.

    Raises:
        ValueError: an unknown layout, or one without runs.
    """

    title: str
    experiment: str
    runs: Sequence[str] = ()
    layout: str | None = None
    command: str | None = None
    claims: Sequence[str] = ()
    table: str | None = None
    differs: str = ""

    def __post_init__(self) -> None:
        if self.layout is not None and (self.layout not in LAYOUTS or not self.runs):
            raise ValueError(
                f"experiments.rows, {self.experiment}: want runs and a layout of {', '.join(LAYOUTS)}, got "
                f"{self.layout!r}, {list(self.runs)}"
            )

    @property
    def exists(self) -> bool:
        return (conf_directory() / "experiment" / f"{self.experiment}.yaml").is_file()

    @property
    def run(self) -> str:
        """The command."""
        return self.command or f"python -m src.main +experiment={self.experiment}"


@dataclass(frozen=True)
class Experiments:
    """``+experiment=experiments_table``.

    Args:
        rows: the constructor arguments of each :class:`Row`, by a name of its own.
        paper: ``claims`` and ``tables`` of conf/paper/numbers.yaml.
        only: names of the rows to make; null: all.
        page: where the page goes besides the run's folder; null: nowhere.
        reference: the method that the others are compared with.
        draws: of the bootstrap.

    Raises:
        ValueError: an unknown row, claim or table, fewer than two draws, or a ``page`` of some rows ``only``.
    """

    rows: Mapping[str, Mapping[str, Any]]
    paper: Mapping[str, Mapping[str, Any]]
    only: Sequence[str] | None = None
    page: str | None = None
    reference: str = "neural_sim"
    draws: int = 300

    def __post_init__(self) -> None:
        unknown = sorted(set(self.only or ()) - set(self.rows))
        if unknown:
            raise ValueError(f"experiments.only: no row {unknown}, want some of {', '.join(self.rows)}")
        if self.draws < 2:
            raise ValueError(f"experiments.draws must be at least 2, got {self.draws}")
        if self.page is not None and self.only is not None:
            raise ValueError("experiments.page: want all rows on the page, so experiments.only=null")
        for row in (Row(**arguments) for arguments in self.rows.values()):
            missing = [c for c in row.claims if c not in self.paper["claims"]]
            missing += [t for t in (row.table,) if t is not None and t not in self.paper["tables"]]
            if missing:
                raise ValueError(f"experiments.rows, {row.experiment}: the paper's numbers have no {missing}")
        _ = self._tables

    @property
    def _tables(self) -> dict[str, Paper]:
        return {name: Paper(**table) for name, table in self.paper["tables"].items()}

    def write(self, uri: str, config: Mapping[str, Any], folder: Path) -> str:
        """experiments.md, experiments.json and figures in ``folder``, and the page where it is asked for; returns the
        page's text. Only runs with the ``budget`` of ``config`` count."""
        settings = Settings(uri, config["budget"], self.reference, self.draws, config["seed"])
        made = {
            name: Row(**arguments)
            for name, arguments in self.rows.items()
            if self.only is None or name in self.only
        }
        shown = {name: self._shown(row, settings) for name, row in made.items() if row.exists}
        for name, (_, result, _) in shown.items():
            for called, figure in (result.figures if result else {}).items():
                figures.save(figure, folder / "figures" / f"{name}_{called}.png")
        text = self._page(shown, config["budget"])
        lost = list(dict.fromkeys(run for _, _, left in shown.values() for run in left))
        (folder / "experiments.md").write_text(text)
        (folder / "left_out.md").write_text("\n".join(left_out_table(lost)) + "\n")
        data = {name: {"command": row.run, "ours": list(result.lines) if result else None}
                for name, (row, result, _) in shown.items()}  # fmt: skip
        (folder / "experiments.json").write_text(
            json.dumps({"rows": data, "left_out": [asdict(run) for run in lost]}, indent=1)
        )
        if self.page is not None:
            Path(self.page).write_text(text)
        return text

    def _shown(self, row: Row, settings: Settings) -> tuple[Row, Shown | None, list[LeftOut]]:
        if row.layout is None:
            return row, Shown(["in the run's folder"]), []
        found, left_out = settings.read(row.runs)
        if not found:
            return row, None, left_out
        table = self._tables.get(row.table) if row.table else None
        shown = LAYOUTS[row.layout](found, table, settings.draws, settings.seed)
        spent = costs_table([run for setting in found for run in setting.runs])
        return row, replace(shown, text="\n\n".join(part for part in (shown.text, spent) if part)), left_out

    def _page(
        self, shown: Mapping[str, tuple[Row, Shown | None, list[LeftOut]]], budget: Mapping[str, Any]
    ) -> str:
        views, training, outer = budget["views"], budget["training"], budget["outer"]
        lines = [
            "# Experiments",
            "",
            f"Written by `{COMMAND}` from finished runs in MLflow; do not edit.",
            "",
            f"Ours: runs with {views['count']} views of {views['image_size']} pixels per object, detectors at "
            f"{training['image_size']} pixels and {outer['iterations']} iterations. AP is 0.50 to 0.95 on the test "
            "set, in points; brackets are 95 % bootstrap intervals over seeds and test images. NS is no optimisation, "
            "NSO is `baseline=neural_sim`. Line numbers are those of the paper's LaTeX source.",
            "",
            "| the paper's experiment | command | ours | the paper | what differs |",
            "|---|---|---|---|---|",
        ]
        for row, result, _ in shown.values():
            ours = "<br>".join(result.lines) if result else NOT_YET
            lines.append(
                f"| {row.title} | `{row.run}` | {ours} | {'<br>'.join(self._claims(row))} | {row.differs} |"
            )
        for name, (row, result, _) in shown.items():
            parts = [result.text] if result and result.text else []
            if row.table and not parts:
                parts = [self._tables[row.table].markdown()]
            if parts:
                lines += ["", f"## {name.replace('_', ' ')}", "", f"{row.title}.", "", *parts]
        used = {row.table for row, _, _ in shown.values()}
        others = [table for name, table in self._tables.items() if name not in used]
        if others and self.only is None:
            lines += ["", "## Tables of the paper without an experiment here", ""]
            lines += ["\n\n".join(table.markdown() for table in others)]
        return "\n".join(lines) + "\n"

    def _claims(self, row: Row) -> list[str]:
        """What the paper says, with its source."""
        found = [claim for name in row.claims for claim in self.paper["claims"][name]]
        texts = [f"{c['what']} {c['value']} ({c['source']}, l. {c['line']})" for c in found]
        if row.table:
            texts.append(f"{self._tables[row.table].title}: below")
        return texts
