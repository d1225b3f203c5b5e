"""Processes that cannot start end the work with one line; nothing waits for them forever."""

import functools
import operator
import subprocess
import sys
from multiprocessing.context import SpawnProcess

import pytest

from neural_sim.processes import Work, WorkersLost, processes

UNGUARDED = """
import functools, operator
from pathlib import Path
from neural_sim.processes import Work, processes

with processes(1, Work(functools.partial(operator.add, bytes(10**6)), Path(), 1)) as submit:
    submit(b"").result()
"""


def test_a_process_that_ends_before_it_reads_its_task_is_not_waited_for(tmp_path):
    """A program that starts processes when it is imported, and a task that fills the pipe to them."""
    (tmp_path / "program.py").write_text(UNGUARDED)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "program.py")], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert "WorkersLost: a process was killed from outside" in done.stderr.splitlines()[-1]


def test_a_process_that_the_system_refuses_is_one_line(tmp_path, monkeypatch):
    def refuse(process):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(SpawnProcess, "_Popen", staticmethod(refuse))
    wanted = r"^a process could not start \(Resource temporarily unavailable\); want fewer workers$"
    with (
        pytest.raises(WorkersLost, match=wanted),
        processes(2, Work(functools.partial(operator.add, 1), tmp_path, 1)) as submit,
    ):
        submit(1)
