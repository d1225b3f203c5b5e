"""Runs by an MLflow server, which keeps them in a database of its own."""

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from mlflow import MlflowClient

ROOT = Path(__file__).parents[2]
SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "detector=micro", "views.count=8", "views.held_out=2",
    "budget.grid.steps=20", "budget.grid.resolution=64", "target.val_per_object=4", "objects.names=[pitcher,drill]",
    "outer.iterations=2",
]  # fmt: skip


@pytest.fixture
def server(tmp_path, empty_store):
    """The address of a server, and its database."""
    database = tmp_path / "server.db"
    database.write_bytes(empty_store.read_bytes())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{database}", "--workers", "1",
        "--artifacts-destination", str(tmp_path / "artifacts"), "--host", "127.0.0.1", "--port", str(port),
    ]  # fmt: skip
    with (tmp_path / "server.log").open("w") as log:
        environment = {**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true"}
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=tmp_path)
    try:
        address = f"http://127.0.0.1:{port}"
        for _ in range(240):
            try:
                urllib.request.urlopen(f"{address}/health", timeout=1)
                break
            except (urllib.error.URLError, OSError):
                assert process.poll() is None, (tmp_path / "server.log").read_text()[-2000:]
                time.sleep(0.5)
        yield address, database
    finally:
        process.terminate()
        process.wait(30)


@pytest.mark.slow
def test_a_run_by_a_server_is_in_its_database_with_its_files(server, tmp_path):
    address, database = server
    command = [
        sys.executable, "-m", "src.main", *SMALL, f"paths.mlflow={address}", f"paths.store={tmp_path}/store",
        f"hydra.run.dir={tmp_path}/run",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"{address}/#/experiments/" in done.stdout and "warning" not in done.stderr.lower()
    client = MlflowClient(f"sqlite:///{database}")
    experiment = client.get_experiment_by_name("pose_gap")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED" and run.data.params["detector._target_"]
    assert "validation_ap" in run.data.metrics
    history = client.get_metric_history(run.info.run_id, "psi/images")
    assert [each.step for each in history] == [1, 2] or [each.step for each in history] == [0, 1]
    (artifacts,) = (tmp_path / "artifacts").glob(f"*/{run.info.run_id}/artifacts")
    assert (artifacts / "results.json").read_bytes() == (tmp_path / "run" / "results.json").read_bytes()
