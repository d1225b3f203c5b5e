"""What a task publishes: files, and one finished run in MLflow."""

import errno
import json
import shutil
import time
from types import SimpleNamespace

import pytest

from neural_sim.configuration import UserError
from neural_sim.report.figures import Figure
from neural_sim.report.tracking import connect
from neural_sim.tasks.context import Context


@pytest.fixture
def context(tmp_path, empty_store):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    store = str(tmp_path / "mlflow.db")
    config = {"name": "study", "seed": 3, "mine": {"draws": 2}, "other": 1, "paths": {"mlflow": store}}
    return Context(config, tmp_path / "run", lambda: SimpleNamespace(), ("mine",))


def published(context, **more):
    context.folder.mkdir(exist_ok=True)
    (context.folder / "rows.csv").write_text("a,b\n")
    metrics = {"ap": 0.5, "unknown": None, "bad": float("nan"), "bias": [0.1, 0.2]}
    figures = {"bars": Figure(figsize=(1, 1))}
    run = context.publish("mine", {"ap": float("nan"), "rows": (1, 2)}, "# Mine\n", figures, metrics, **more)
    return connect(context.uri), run.run_id


def test_document_text_and_figures_are_in_the_folder_and_said(context, capsys):
    _, run_id = published(context)
    assert json.loads((context.folder / "mine.json").read_text()) == {"ap": None, "rows": [1, 2]}
    assert (context.folder / "mine.md").read_text() == "# Mine\n"
    assert (context.folder / "figures" / "bars.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert printed.startswith(f"# Mine\nresults: {context.folder}\n") and run_id in printed


def test_the_run_has_the_folder_numbers_and_series(context):
    begun = context.begun = time.time() - 60
    client, run_id = published(context, tags={"method": "pathwise"}, title="two")
    run = client.get_run(run_id)
    assert run.info.status == "FINISHED" and run.info.start_time == int(1000 * begun)
    assert run.info.run_name == "two"
    assert (run.data.tags["seed"], run.data.tags["method"]) == ("3", "pathwise")
    assert run.data.metrics == {"ap": 0.5, "bias": 0.2}
    assert [m.value for m in client.get_metric_history(run_id, "bias")] == [0.1, 0.2]
    assert {f.path for f in client.list_artifacts(run_id)} == {"mine.json", "mine.md", "figures", "rows.csv"}
    assert client.get_experiment(run.info.experiment_id).name == "study"


def test_the_whole_configuration_counts_where_the_experiment_was_built(context):
    client, run_id = published(context)
    assert client.get_run(run_id).data.params == {"mine.draws": "2", "seed": "3"}
    assert client.get_run(run_id).info.run_name == "seed 3"
    _ = context.experiment
    client, run_id = published(context)
    assert client.get_run(run_id).data.params["other"] == "1"


def test_a_task_without_a_text_leaves_the_document(context, capsys):
    context.publish("mine", [])
    assert sorted(path.name for path in context.folder.iterdir()) == ["mine.json"]
    assert capsys.readouterr().out.startswith("results: ")


def test_a_tracking_store_that_fails_costs_a_line(context, capsys, caplog):
    (context.folder.parent / "mlflow.db").write_text("no database")
    assert context.publish("mine", [1], "# Mine") is None
    assert json.loads((context.folder / "mine.json").read_text()) == [1]
    assert capsys.readouterr().out == f"# Mine\nresults: {context.folder}\n"
    (line,) = (record.getMessage() for record in caplog.records)
    assert "mlflow.db is not an SQLite database" in line and line.endswith("not in MLflow")


def test_a_full_disk_is_told_with_the_folder_that_was_written_to(context):
    with (
        pytest.raises(
            UserError, match=rf"^mine: {context.folder} cannot be written to: No space .* are kept$"
        ),
        context.running("mine"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(FileNotFoundError), context.running("mine"):  # says itself which file it is
        (context.folder / "none").read_text()
