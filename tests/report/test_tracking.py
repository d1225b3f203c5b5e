"""Runs written to MLflow while they go on, and read back."""

import subprocess
import sys

import pytest
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException

from neural_sim.interruption import this_process
from neural_sim.report import tracking
from neural_sim.report.database import database_of


def opened(uri, **more):
    return tracking.opened(uri, "gap", "ours seed 0", {"seed": "0"}, {"outer.iterations": 3}, **more)


def test_tracking_uri_keeps_uris_and_makes_paths_absolute(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert tracking.tracking_uri("~/mlflow.db") == f"sqlite:///{tmp_path.resolve()}/mlflow.db"
    assert tracking.tracking_uri("http://localhost:5000") == "http://localhost:5000"
    assert tracking.tracking_uri("outputs/mlflow.db").startswith("sqlite:////")
    with pytest.raises(ValueError, match=r"paths\.mlflow"):
        tracking.tracking_uri("")


def test_a_relative_sqlite_uri_is_a_file_in_the_working_directory(uri, monkeypatch):
    """Twice: a new database and one that exists; files of runs need an absolute address."""
    database = database_of(uri)
    monkeypatch.chdir(database.parent)
    for count in (1, 2):
        with opened(f"sqlite:///{database.name}"):
            pass
        assert len(tracking.logged_runs(uri, "gap")) == count


def test_a_run_is_there_while_it_goes_on_and_has_its_duration(uri):
    seconds, reader = iter(range(1000, 2000, 10)), MlflowClient(uri)
    with opened(uri, clock=lambda: float(next(seconds))) as run:
        held = reader.get_run(run.run_id)
        assert held.info.status == "RUNNING" and held.info.end_time is None
        assert held.data.params == {"outer.iterations": "3"} and held.data.tags["seed"] == "0"
        run.log({"psi/loss": 0.5, "psi/cosine": float("nan")}, step=0)
        run.log({"psi/loss": 0.25}, step=1)
        points = reader.get_metric_history(run.run_id, "psi/loss")
        assert [(p.step, p.value, p.timestamp) for p in points] == [(0, 0.5, 1_010_000), (1, 0.25, 1_020_000)]
    held = reader.get_run(run.run_id)
    assert held.info.status == "FINISHED"
    assert (held.info.start_time, held.info.end_time) == (1_000_000, 1_030_000)
    assert set(held.data.metrics) == {"psi/loss"}


def _as_lightning_does():
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        sys.exit(1)


@pytest.mark.parametrize(
    ("stop", "status", "cause"),
    [
        (lambda: {}["views"], "FAILED", "KeyError: 'views'"),
        (lambda: sys.exit(3), "FAILED", "SystemExit: 3"),
        (lambda: (_ for _ in ()).throw(KeyboardInterrupt), "KILLED", "KeyboardInterrupt: "),
        (_as_lightning_does, "KILLED", "SystemExit: 1"),
    ],
)
def test_a_run_that_does_not_end_well_says_so(uri, stop, status, cause):
    with pytest.raises((KeyError, SystemExit, KeyboardInterrupt)), opened(uri) as run:
        run.log({"psi/loss": 0.5})
        stop()
    held = MlflowClient(uri).get_run(run.run_id)
    assert held.info.status == status and held.info.end_time >= held.info.start_time
    assert held.data.tags["error"] == cause and held.data.metrics == {"psi/loss": 0.5}


class Away:
    """A client whose store does not answer for the first ``times`` of writing."""

    def __init__(self, client, times):
        self._client, self.times = client, times

    def log_batch(self, *arguments, **more):
        self.times -= 1
        if self.times >= 0:
            raise MlflowException("the store is away")
        return self._client.log_batch(*arguments, **more)

    def __getattr__(self, name):
        return getattr(self._client, name)


def test_what_the_store_refuses_for_now_is_written_later(uri, caplog):
    reader = MlflowClient(uri)
    with opened(uri) as run:
        run._client = Away(run._client, times=2)
        for step in range(2):
            run.log({"psi/loss": float(step)}, step)
        assert not reader.get_metric_history(run.run_id, "psi/loss")
        assert caplog.text.count("its metrics are kept for the next write (the store is away)") == 2
        run.log({"psi/loss": 2.0}, 2)
        assert len(reader.get_metric_history(run.run_id, "psi/loss")) == 3
    with opened(uri) as run:  # what never gets through costs the numbers there, not the results and the exit
        run._client = Away(run._client, times=9)
        run.log({"psi/loss": 0.0})
    assert "the last metrics are lost (the store is away)" in caplog.text
    with pytest.raises(KeyError), opened(uri) as run:  # the cause is told, not that it could not be written
        run._client = Away(run._client, times=9)
        run.log({"psi/loss": 0.0})
        {}["views"]


def test_names_of_objects_are_brought_to_mlflows_characters(uri):
    parameters = {"parameter.pose.biased.cup (1).initial": "uniform"}
    with tracking.opened(uri, "gap", "run", {}, parameters) as run:
        run.log({"psi/tasse à café+/bin_1": 0.5})
    held = MlflowClient(uri).get_run(run.run_id).data
    assert held.params == {"parameter.pose.biased.cup _1_.initial": "uniform"}
    assert held.metrics == {"psi/tasse à café_/bin_1": 0.5}


def test_experiments_are_of_the_kind_model_training(uri):
    client = MlflowClient(uri)
    kinds = {"gap": None, "older": None, "other": "genai_development"}
    for name in ("older", "other"):
        client.create_experiment(name, tags={tracking.KIND[0]: kinds[name]} if kinds[name] else None)
    for name in kinds:
        with tracking.opened(uri, name, "run", {}, {}):
            pass
    found = {name: client.get_experiment_by_name(name).tags.get("mlflow.experimentKind") for name in kinds}
    model = "custom_model_development"
    assert found == {"gap": model, "older": model, "other": "genai_development"}


def test_the_address_of_a_run_and_of_a_table(uri):
    with opened(uri) as run:
        pass
    command, address = run.where.splitlines()
    assert command == f"mlflow ui --backend-store-uri {uri}"
    found = MlflowClient(uri).get_experiment_by_name("gap").experiment_id
    base = f"http://127.0.0.1:5000/#/experiments/{found}/runs"
    spaced = tracking.where("sqlite:////my runs/mlflow.db", "3").splitlines()[0]
    assert spaced == "mlflow ui --backend-store-uri 'sqlite:////my runs/mlflow.db'"
    assert address == f"{base}/{run.run_id}?workflowType=machine_learning"
    assert tracking.where_runs(uri, "gap").endswith(f"\n{base}?workflowType=machine_learning")
    assert tracking.where("https://host:80/", "3", "ab") == (
        "https://host:80/#/experiments/3/runs/ab?workflowType=machine_learning"
    )
    assert tracking.where("databricks", "3", "ab") == "databricks: experiment 3, run ab"


def test_a_store_that_does_not_answer_is_a_users_error(monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    message = r"paths\.mlflow: http://127\.0\.0\.1:9 cannot be written to"
    with pytest.raises(ValueError, match=message), opened("http://127.0.0.1:9"):
        pass


def test_runs_come_back_with_their_files_the_latest_first(uri, tmp_path):
    for number, names in enumerate((["a.json", "b.json"], ["a.json"])):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in names:
            (folder / name).write_text(f"{number}")
        with tracking.opened(uri, "gap", f"run {number}", {}, {}, begun=100.0 + number) as run:
            run.log_files(folder)
    with pytest.raises(KeyError), opened(uri, begun=1.0):
        {}["views"]
    found = tracking.logged_runs(uri, "gap")
    assert [(run.name, run.status, set(run.files)) for run in found] == [
        ("run 1", "FINISHED", {"a.json"}), ("run 0", "FINISHED", {"a.json", "b.json"}),
        ("ours seed 0", "FAILED", set()),
    ]  # fmt: skip
    assert found[1].fetch("b.json").read_text() == "0"
    with pytest.raises(ValueError, match=r"no experiment 'other', only \['gap'\]"):
        tracking.logged_runs(uri, "other")


def test_runs_of_processes_that_are_gone_are_closed_by_the_next(uri, caplog):
    """A run as kill -9 leaves it, one of a living process, one of another machine, and one of another program."""
    client = tracking.connect(uri)
    machine, space, pid, start = this_process().split(" ")
    owners = {
        "dead": f"{machine} {space} {pid} {int(start) - 1}",
        "before the last boot": f"{machine}0 {space} {pid} {start}",
        "alive": this_process(),
        "in another container": f"{machine} {space}0 {pid} 1",
        "elsewhere": f"other/{machine.partition('/')[2]} {space} 1 1",
        "unknown": "",
    }
    runs = {
        name: client.create_run(
            "0", tags={**tracking.SOURCE, tracking.PROCESS: owner}, run_name=name
        ).info.run_id
        for name, owner in owners.items()
    }
    runs["foreign"] = client.create_run("0", tags={tracking.PROCESS: owners["dead"]}).info.run_id
    with caplog.at_level("INFO"), opened(uri) as run:
        assert client.get_run(run.run_id).info.status == "RUNNING"
    status = {name: client.get_run(run_id).info.status for name, run_id in runs.items()}
    assert status == {
        "dead": "KILLED", "before the last boot": "KILLED", "alive": "RUNNING",
        "in another container": "RUNNING", "elsewhere": "RUNNING", "unknown": "RUNNING", "foreign": "RUNNING",
    }  # fmt: skip
    assert f"run {runs['dead']} (dead) is KILLED" in caplog.text
    assert client.get_run(runs["dead"]).data.tags["error"] == "its process ended without closing it"


def test_a_run_that_kill_9_left_open_is_closed(uri):
    worker = subprocess.Popen([sys.executable, "-c", KILLED, uri], stdout=subprocess.PIPE, text=True)
    assert worker.stdout.readline() == "open\n"
    worker.kill()
    worker.wait()
    (left,) = tracking.logged_runs(uri, "gap")
    assert left.status == "RUNNING"
    assert tracking.close_abandoned(tracking.connect(uri)) == [left.run_id]
    assert [run.status for run in tracking.logged_runs(uri, "gap")] == ["KILLED"]


KILLED = """
import sys, time
from neural_sim.report import tracking
with tracking.opened(sys.argv[1], "gap", "killed", {}, {}):
    print("open", flush=True)
    time.sleep(600)
"""


WORKER = """
import sys
from neural_sim.report import tracking
with tracking.opened(sys.argv[1], "gap", sys.argv[2], {}, {"seed": sys.argv[2]}) as run:
    for step in range(20):
        run.log({f"psi/{k}": float(step) for k in range(50)}, step)
"""


@pytest.mark.slow  # a new MLflow store, and three processes that import MLflow
def test_workers_that_start_together_share_a_new_database(tmp_path):
    uri = tracking.tracking_uri(str(tmp_path / "mlflow.db"))
    workers = [
        subprocess.Popen([sys.executable, "-c", WORKER, uri, str(seed)], stderr=subprocess.PIPE, text=True)
        for seed in range(3)
    ]
    for worker in workers:
        _, errors = worker.communicate(timeout=300)
        assert worker.returncode == 0, errors
        assert "metrics wait" not in errors
    found = tracking.logged_runs(uri, "gap")
    assert sorted(run.name for run in found) == ["0", "1", "2"] and {run.status for run in found} == {
        "FINISHED"
    }
    for run in found:
        assert len(MlflowClient(uri).get_metric_history(run.run_id, "psi/49")) == 20
