"""A tracking store that fails costs neither the results nor the exit, and says so in one line with its key."""

import logging
import sqlite3
import subprocess
import sys

import pytest

from neural_sim.report import tracking


@pytest.fixture
def uri(tmp_path) -> str:
    return tracking.tracking_uri(str(tmp_path / "mlflow.db"))


def opened(uri: str):
    return tracking.opened(uri, "gap", "run", {}, {})


def test_a_full_disk_at_the_end_is_a_warning(uri, tmp_path, monkeypatch, caplog):
    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device", "artifact")

    with caplog.at_level(logging.WARNING), opened(uri) as run:
        monkeypatch.setattr(run._client, "log_artifacts", full)
        monkeypatch.setattr(run._client, "set_terminated", full)
        run.log_files(tmp_path)
    assert "not all files of" in caplog.text and "No space left on device" in caplog.text
    assert "it stays open instead of FINISHED" in caplog.text


def test_a_database_that_is_damaged_while_a_run_is_open_is_a_warning(uri, tmp_path, caplog):
    with caplog.at_level(logging.WARNING), opened(uri) as run:
        (tmp_path / "mlflow.db").write_bytes(b"SQLite format 3\0" + bytes(8192))
        run.log({"a": 1.0})
    assert "metrics are kept" in caplog.text and "it stays open instead of FINISHED" in caplog.text


@pytest.mark.parametrize("keep", [17, 5000])
def test_a_database_that_is_cut_off_is_refused_at_once(uri, tmp_path, keep):
    with opened(uri):
        pass
    file = tmp_path / "mlflow.db"
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"paths\.mlflow: .*mlflow\.db.*(damaged|cannot be)"), opened(uri):
        raise AssertionError("was opened")


def test_a_place_where_no_file_can_be_is_refused_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(
            ValueError, match=r"paths\.mlflow: .*file/mlflow\.db cannot be used .*set paths\.mlflow"
        ),
        opened(tracking.tracking_uri(str(tmp_path / "file" / "mlflow.db"))),
    ):
        raise AssertionError("was opened")


def test_an_older_database_is_upgraded_after_a_copy(uri, tmp_path, caplog):
    from alembic import command
    from mlflow.store.db.utils import _get_alembic_config

    with opened(uri) as run:
        run.log({"a": 1.0})
    file = tmp_path / "mlflow.db"
    with tracking.quiet():
        command.downgrade(_get_alembic_config(uri), "-1")
    with sqlite3.connect(file) as connection:
        (before,) = connection.execute("select version_num from alembic_version").fetchone()
    with caplog.at_level(logging.WARNING), opened(uri) as run:
        run.log({"a": 2.0})
    copy = tmp_path / f"mlflow.db.{before}.copy"
    (line,) = [record.getMessage() for record in caplog.records]
    assert f"{file} is of an older version: it is copied to {copy.name} and upgraded" in line
    with sqlite3.connect(copy) as connection:
        assert connection.execute("select version_num from alembic_version").fetchone() == (before,)
        assert connection.execute("select count(*) from runs").fetchone() == (1,)
    assert len(tracking.logged_runs(uri, "gap")) == 2


HALF_WRITTEN = """
import os, signal, sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
connection.execute("pragma cache_size = 1")
connection.execute("create table large (content blob)")
connection.executemany("insert into large values (zeroblob(5000))", [()] * 100)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_half_written_is_undone(uri, tmp_path):
    with opened(uri):
        pass
    file = tmp_path / "mlflow.db"
    subprocess.run([sys.executable, "-c", HALF_WRITTEN, str(file)], check=False)
    assert file.with_name("mlflow.db-journal").stat().st_size
    with opened(uri) as run:
        run.log({"a": 1.0})
    assert len(tracking.logged_runs(uri, "gap")) == 2
    with sqlite3.connect(file) as connection:
        assert connection.execute("select count(*) from large").fetchone() == (0,)


def test_a_database_that_another_program_holds_is_not_called_damaged(uri, tmp_path, monkeypatch):
    monkeypatch.setattr("neural_sim.report.database._PATIENCE", 0.1)
    with opened(uri):
        pass
    with sqlite3.connect(tmp_path / "mlflow.db") as connection:
        connection.execute("begin exclusive")
        with (
            pytest.raises(
                ValueError, match=r"mlflow\.db cannot be used \(database is locked\); move it away"
            ),
            opened(uri),
        ):
            raise AssertionError("was opened")


def test_a_disk_that_fills_while_the_configuration_is_written_is_refused_in_one_line(uri, monkeypatch):
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    def full(*_args, **_kwargs):
        raise MlflowException("(sqlite3.OperationalError) database or disk is full")

    monkeypatch.setattr(MlflowClient, "log_batch", full)
    with (
        pytest.raises(ValueError, match=r"^paths\.mlflow: .* cannot be written to .*disk is full\)$"),
        tracking.opened(uri, "gap", "run", {}, {"seed": 0}),
    ):
        raise AssertionError("was opened")


def test_a_disk_that_is_read_only_is_told_as_such(uri, monkeypatch):
    def refuse(_):
        raise OSError(30, "Read-only file system", "mlflow.db.lock")

    monkeypatch.setattr(tracking, "guard", refuse)
    with (
        pytest.raises(
            ValueError, match=r"cannot be written to \(Read-only file system\); set paths\.mlflow$"
        ),
        opened(uri),
    ):
        raise AssertionError("was opened")


def test_a_database_of_other_tables_is_refused(uri, tmp_path):
    with sqlite3.connect(tmp_path / "mlflow.db") as connection:
        connection.execute("create table alembic_version (version_num varchar(32))")
        connection.execute("insert into alembic_version values ('ffffffffffff')")
    with pytest.raises(ValueError, match=r"paths\.mlflow: .*a newer MLflow may have written it"), opened(uri):
        raise AssertionError("was opened")
