"""Runs written to MLflow and read back."""

import pytest

from neural_sim.report import tracking


def test_tracking_uri_keeps_uris_and_makes_paths_absolute(tmp_path):
    assert tracking.tracking_uri("http://localhost:5000") == "http://localhost:5000"
    assert tracking.tracking_uri("outputs/mlflow.db").startswith("sqlite:////")
    with pytest.raises(ValueError, match=r"paths\.mlflow"):
        tracking.tracking_uri("")


def test_runs_come_back_with_their_files_the_latest_first(tmp_path):
    uri = tracking.tracking_uri(str(tmp_path / "mlflow.db"))
    for number, names in enumerate((["a.json", "b.json"], ["a.json"])):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in names:
            (folder / name).write_text(f"{number}")
        tracking.log_run(uri, "gap", f"run {number}", {}, {}, {}, {}, folder)
    found = tracking.runs(uri, "gap")
    assert [(run.name, run.status, set(run.files)) for run in found] == [
        ("run 1", "FINISHED", {"a.json"}), ("run 0", "FINISHED", {"a.json", "b.json"}),
    ]  # fmt: skip
    assert found[1].fetch("b.json").read_text() == "0"
    with pytest.raises(ValueError, match=r"no experiment 'other', only \['gap'\]"):
        tracking.runs(uri, "other")
