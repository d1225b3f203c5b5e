"""The table at the end of a sweep: scores of its runs before and after, by the swept settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from neural_sim.detector.metrics import mean_of
from neural_sim.documents import markdown_table, read_json
from neural_sim.report.provenance import caution
from neural_sim.report.run import CALLED

SCORED = ("ns", "learned", "matched")


def sweep_table(folder: Path) -> str:
    """Return the table of a sweep's runs; empty if fewer than two left results.

    Args:
        folder: the sweep's folder, with a subfolder for each job, whose name begins with the job's number.
    """
    jobs = sorted((path for path in folder.iterdir() if (path / ".hydra").is_dir()), key=_number)
    results = {job: read_json(job / "results.json") for job in jobs if (job / "results.json").is_file()}
    if len(results) < 2:
        return ""
    settings = {job: _overrides(job) for job in jobs}
    keys = dict.fromkeys(key for own in settings.values() for key in own)
    swept = [key for key in keys if len({own.get(key, "") for own in settings.values()}) > 1]
    score = next(iter(results.values()))["score"]
    rows = [
        [*(settings[job].get(key, "") for key in swept), *_scores(results.get(job)), job.name] for job in jobs
    ]
    head = [*swept, *(f"{score} {CALLED[which]}" for which in SCORED), "folder"]
    notes = [said for scale in {own.get("scale", "") for own in results.values()} if (said := caution(scale))]
    about = (
        f"{score} in points, the mean of the objects that start away from the target; of all where none does."
    )
    return "\n\n".join([*notes, markdown_table(head, rows), about, f"pages: {folder}/<folder>/report.html"])


def _number(job: Path) -> int:
    number = job.name.partition("_")[0]
    return int(number) if number.isdecimal() else 0


def _overrides(job: Path) -> dict[str, str]:
    words: Sequence[str] = yaml.safe_load((job / ".hydra" / "overrides.yaml").read_text(encoding="utf-8"))
    parts = (word.lstrip("+").partition("=") for word in words)
    return {key: value for key, _, value in parts}


def _scores(results: Mapping[str, Any] | None) -> list[str]:
    if results is None:
        return ["no results", *[""] * (len(SCORED) - 1)]
    cells = []
    for which in SCORED:
        scores = results["ap"].get(which)
        own = [scores["per_class"][name] for name in results["biased"]] if scores else []
        known = [value for value in own if value is not None]
        mean = sum(known) / len(known) if known else mean_of(scores) if scores else None
        cells.append("" if mean is None else f"{100 * mean:.1f}")
    return cells
