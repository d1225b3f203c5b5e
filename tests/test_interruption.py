"""SIGTERM and Ctrl-C end a command in two seconds, with a status that tells, one line, and a run that is KILLED."""

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mlflow import MlflowClient

ROOT = Path(__file__).parents[1]
LINE = "neural-sim: ended by {}; the same command resumes from the results in the store"
SIGNALS = ((signal.SIGTERM, 143), (signal.SIGINT, 130))
PROGRAM = """
import hashlib, os, signal, time
from neural_sim.interruption import interruptible, last_act

def asleep():
    time.sleep(60)

def in_compiled_code():
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)

def after_colmap():
    from pathlib import Path
    from neural_sim.objects.colmap import read_colmap
    folder = Path(os.environ["FOLDER"])
    try:
        read_colmap(folder, "pot")
    except ValueError:
        time.sleep(60)

def swallowing():
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass

def closing():
    try:
        time.sleep(60)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)  # once more, which changes nothing
        time.sleep(0.1)
        print("closed")

with interruptible(), last_act(lambda error: print("last act:", error)):
    print("begun", flush=True)
    {body}()
"""
SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "baseline=ns", "detector=micro", "views.count=8",
    "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64", "training.cold_epochs=2000",
    "target.val_per_object=4", "objects.names=[pitcher,drill]",
]  # fmt: skip


def _begin(command):
    """Start a command that hears Ctrl-C even where the tests are run in a shell's background."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def _end(process, signum, limit=4.0):
    """Send a signal; return the status, what was printed, and the lines on stderr.

    The limit is twice what is promised, for tests that share their cores with others.
    """
    begun = time.monotonic()
    process.send_signal(signum)
    out, err = process.communicate(timeout=60)
    assert time.monotonic() - begun < limit
    assert "Traceback" not in err
    return process.returncode, out, err.splitlines()


@pytest.mark.parametrize(("signum", "status"), SIGNALS)
@pytest.mark.parametrize(
    ("body", "printed"),
    [("asleep", ""), ("closing", "closed\n"), ("swallowing", "last act: {}\n"), ("in_compiled_code", "last act: {}\n")],
)  # fmt: skip
def test_a_signal_ends_the_process_wherever_it_is(signum, status, body, printed):
    process = _begin([sys.executable, "-c", PROGRAM.replace("{body}", body)])
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.1)
    found = _end(process, signum)
    assert found == (status, printed.format(signum.name), [LINE.format(signum.name)])


def test_sigterm_still_ends_a_command_that_has_read_a_colmap_model(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="the extra photos is not installed")
    (tmp_path / "cameras.txt").write_text("no model\n", encoding="utf-8")
    monkeypatch.setenv("FOLDER", str(tmp_path))
    process = _begin([sys.executable, "-c", PROGRAM.replace("{body}", "after_colmap")])
    assert process.stdout.readline() == "begun\n"
    while f"pycolmap{os.sep}" not in Path(f"/proc/{process.pid}/maps").read_text(encoding="utf-8"):
        time.sleep(0.1)
    time.sleep(3.0)
    found = _end(process, signal.SIGTERM)
    assert found[0] == 143 and found[2][-1:] == [LINE.format("SIGTERM")]


def test_what_was_set_before_is_there_again_afterwards():
    code = (
        "import signal\nfrom neural_sim.interruption import interruptible\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "with interruptible():\n    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN\n"
        "    assert callable(signal.getsignal(signal.SIGTERM))\n"
        "assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL and signal.set_wakeup_fd(-1) == -1\n"
    )
    process = _begin([sys.executable, "-c", code])
    assert process.communicate(timeout=60) == ("", "") and process.returncode == 0


def test_ctrl_c_ends_in_the_ordinary_way_what_it_is_meant_to_end():
    code = (
        "import time\nfrom neural_sim.interruption import ctrl_c_as_exception, interruptible\n"
        "with interruptible():\n    try:\n        with ctrl_c_as_exception():\n            print('begun', flush=True)\n"
        "            time.sleep(60)\n    except KeyboardInterrupt:\n        print('ended')\n"
    )
    process = _begin([sys.executable, "-c", code])
    assert process.stdout.readline() == "begun\n"
    assert _end(process, signal.SIGINT) == (0, "ended\n", [])


def test_ctrl_c_that_is_read_late_is_told_by_where_it_came_and_the_next_one_still_ends():
    code = (
        "import os, time\nfrom neural_sim import interruption\nread = os.read\n"
        "def late(*arguments):\n    byte = read(*arguments)\n    time.sleep(0.2 * (byte == b'\\x02'))\n"
        "    return byte\n"
        "interruption.os.read = late\n"
        "with interruption.interruptible():\n    try:\n        with interruption.ctrl_c_as_exception():\n"
        "            print('begun', flush=True)\n            time.sleep(60)\n"
        "    except KeyboardInterrupt:\n        time.sleep(0.5)\n        print('ended', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = _begin([sys.executable, "-c", code])
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "ended\n"
    time.sleep(2.0)  # the first one, had it been taken for an end, would have ended the process by now
    assert process.poll() is None and _end(process, signal.SIGINT) == (130, "", [LINE.format("SIGINT")])


def _command(folder, *arguments):
    paths = [f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db"]
    return _begin([sys.executable, "-m", "src.main", *arguments, *paths])


def _wait_for(process, folder, pattern):
    while not list(folder.glob(pattern)):
        assert process.poll() is None, process.stderr.read()[-3000:]
        time.sleep(0.05)


@pytest.mark.parametrize(("signum", "status"), SIGNALS)
def test_a_command_that_is_just_starting_ends(tmp_path, signum, status):
    process = _command(tmp_path, *SMALL, f"hydra.run.dir={tmp_path}/run")
    _wait_for(process, tmp_path, "run/.hydra/overrides.yaml")
    time.sleep(0.3)
    assert _end(process, signum) == (status, "", [LINE.format(signum.name)])


@pytest.mark.slow
def test_a_run_ends_while_it_trains_and_goes_on_later(tmp_path, empty_store):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    arguments = [*SMALL, f"hydra.run.dir={tmp_path}/run"]
    process = _command(tmp_path, *arguments)
    _wait_for(process, tmp_path, "store/detector/*.lock")
    time.sleep(2)
    code, _, lines = _end(process, signal.SIGTERM)
    assert code == 143 and lines[-1] == LINE.format("SIGTERM")
    (run,) = MlflowClient(f"sqlite:///{tmp_path}/mlflow.db").search_runs(["1"])
    assert run.info.status == "KILLED" and run.data.tags["error"] == "Interrupted: SIGTERM"
    fields = {path: path.stat().st_mtime_ns for path in tmp_path.glob("store/field/*.pt")}
    assert len(fields) == 2
    process = _command(tmp_path, *arguments, "training.cold_epochs=3")
    assert process.communicate(timeout=600) and process.returncode == 0
    assert {path: path.stat().st_mtime_ns for path in fields} == fields


@pytest.mark.slow
def test_a_sweep_ends_with_the_job_that_runs(tmp_path, empty_store):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    process = _command(tmp_path, "-m", *SMALL, f"hydra.sweep.dir={tmp_path}/sweep", "seed=0,1")
    _wait_for(process, tmp_path, "store/field/*.pt")
    code, _, lines = _end(process, signal.SIGINT)
    assert code == 130 and lines[-1] == LINE.format("SIGINT")
    (job,) = [path.name for path in (tmp_path / "sweep").iterdir() if path.is_dir()]
    assert job.startswith("0_")
