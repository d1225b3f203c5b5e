"""The table of memory by patch size, and what MLflow keeps of it."""

import json

from mlflow import MlflowClient

from neural_sim.outer.patch_memory import PatchCost
from neural_sim.report.patch_memory import report_patch_memory

ROWS = [
    PatchCost("pitcher", "forward", None, 1.25, 9.5, 13.0, 26.0, 0.0),
    PatchCost("pitcher", "reverse, patches of 64", 64, 0.5, 8.0, 250.4, 251.0, 2e-6),
]


def test_the_files_and_the_run_have_every_row(tmp_path, uri):
    run = report_patch_memory(
        ROWS, "a field", "patch_memory", 4, {"seed": 4}, uri, tmp_path / "run", begun=0.0
    )
    text = (tmp_path / "run" / "patch_memory.md").read_text()
    assert "| reverse, patches of 64 | 0.50 | 8.0 | 250 | 251 | 2e-06 |" in text and "**pitcher**" in text
    document = json.loads((tmp_path / "run" / "patch_memory.json").read_text())
    assert [row["patch"] for row in document["rows"]] == [None, 64]
    logged = MlflowClient(uri).get_run(run.run_id).data
    assert (
        logged.metrics["pitcher/64/gradient_mb"] == 0.5 and logged.metrics["pitcher/forward/total_mb"] == 9.5
    )
