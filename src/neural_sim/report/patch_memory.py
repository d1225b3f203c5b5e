"""The table and the record of `+experiment=patch_memory`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neural_sim.outer.patch_memory import PatchCost
from neural_sim.report import tracking


def report_patch_memory(
    rows: Sequence[PatchCost],
    setting: str,
    experiment: str,
    seed: int,
    config: Mapping[str, Any],
    uri: str,
    folder: Path,
    begun: float,
) -> tracking.Run:
    """patch_memory.md and patch_memory.json in ``folder``, and a run in MLflow that began at ``begun`` (seconds since
    1970); ``setting`` is the table's heading.
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = {"setting": setting, "rows": [dataclasses.asdict(row) for row in rows]}
    (folder / "patch_memory.json").write_text(json.dumps(document, indent=1))
    text = table(rows, setting)
    (folder / "patch_memory.md").write_text(text + "\n")
    print(text)
    metrics = {
        f"{row.object}/{'forward' if row.patch is None else row.patch}/{key}": getattr(row, key)
        for row in rows
        for key in ("gradient_mb", "total_mb", "milliseconds", "cpu_milliseconds")
    }
    tags = {"method": "pathwise", "seed": str(seed)}
    parameters = tracking.flatten(config)
    return tracking.log_run(uri, experiment, f"seed {seed}", tags, parameters, metrics, {}, folder, begun)


def table(rows: Sequence[PatchCost], setting: str) -> str:
    """Markdown, a table for each object."""
    lines = [
        f"Derivative of one image by the scene parameters that depend on psi ({setting}). *Gradient* is the working "
        "memory of the renderer's derivative, *total* that of the whole estimate with the detector's, from one image "
        "of every object."
    ]
    for name in dict.fromkeys(row.object for row in rows):
        lines += [
            "",
            f"**{name}**",
            "",
            "| method | gradient, MB | total, MB | ms | CPU ms | relative difference from forward |",
            "|---|---|---|---|---|---|",
        ]
        for row in (row for row in rows if row.object == name):
            lines.append(
                f"| {row.method} | {row.gradient_mb:.2f} | {row.total_mb:.1f} | {row.milliseconds:.0f} "
                f"| {row.cpu_milliseconds:.0f} | {row.difference:.0e} |"
            )
    return "\n".join(lines)
