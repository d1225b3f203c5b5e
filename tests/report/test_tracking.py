"""Runs written to MLflow and read back."""

import pytest

from neural_sim.report import tracking


def test_tracking_uri_keeps_uris_and_makes_paths_absolute(tmp_path):
    assert tracking.tracking_uri("http://localhost:5000") == "http://localhost:5000"
    assert tracking.tracking_uri("outputs/mlflow.db").startswith("sqlite:////")
    with pytest.raises(ValueError, match=r"paths\.mlflow"):
        tracking.tracking_uri("")


def test_only_finished_files_that_are_asked_for_come_back_the_latest_run_first(tmp_path):
    uri = tracking.tracking_uri(str(tmp_path / "mlflow.db"))
    for number, names in enumerate((["a.json", "b.json"], ["a.json"], ["a.json", "b.json", "big.bin"])):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in names:
            (folder / name).write_text(f"{number}")
        tracking.log_run(uri, "gap", f"run {number}", {}, {}, {}, {}, folder)
    found = tracking.finished_files(uri, "gap", ("a.json", "b.json"))
    assert [{name: path.read_text() for name, path in run.items()} for run in found] == [
        {"a.json": "2", "b.json": "2"},
        {"a.json": "0", "b.json": "0"},
    ]
    with pytest.raises(ValueError, match=r"no experiment 'other', only \['gap'\]"):
        tracking.finished_files(uri, "other", ("a.json",))
