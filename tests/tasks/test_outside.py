"""Tasks beyond those of the package: an unknown one is refused, and a failure of one is the command's."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed

from neural_sim.main import UserError, context_of

ROOT = Path(__file__).parents[2]
PLUGIN = """
from neural_sim.tasks.context import Task, TaskFailure


class Fail(Task):
    def run(self, context):
        raise TaskFailure("two checks failed")
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    (tmp_path / "my_task.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_task", None)


def test_an_unknown_stage_is_one_line_with_those_that_there_are(tmp_path, plugin):
    with pytest.raises(UserError) as caught:
        context_of(composed("+fail={_target_: my_task.Fail}", "stages=[views,fields]"), tmp_path)
    known = "views, field, target_sets, warm_start, psi, evaluate, report"
    more = "preflight, repeat, predict, export, box, viewer, doctor, fail"
    assert str(caught.value) == f"stages: unknown stage 'fields', want some of {known}, {more}"


def test_a_task_that_finds_a_failure_makes_the_exit_status_one(tmp_path, plugin):
    arguments = ["+fail={_target_: my_task.Fail}", "stages=[fail]", f"hydra.run.dir={tmp_path}/run"]
    command = [sys.executable, "-m", "src.main", *arguments]
    places = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": places}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "Traceback" not in done.stderr
