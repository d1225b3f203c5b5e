"""A task from outside the package: one class, one configuration node."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed

from neural_sim.main import UserError, context_of
from neural_sim.tasks.walk import walk

ROOT = Path(__file__).parents[2]
PLUGIN = '''
from dataclasses import dataclass

from neural_sim.tasks.context import Task, TaskFailure


@dataclass(frozen=True)
class Count(Task):
    """Counts the objects and writes the number."""

    times: int = 1

    def run(self, context):
        (context.folder / "count.txt").write_text(str(self.times * len(context.graph.names)))


class Fail(Task):
    def run(self, context):
        raise TaskFailure("two checks failed")
'''


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    (tmp_path / "my_task.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_task", None)


def context(folder, *overrides):
    config = composed("+experiment=pose_gap", "scale=smoke", *overrides)
    return context_of(config, folder)


def test_a_task_from_outside_is_one_class_and_one_node(tmp_path, plugin):
    overrides = ["+count={_target_: my_task.Count, times: 2}", "stages=[count]"]
    assert walk(*context(tmp_path, *overrides)) is None
    assert (tmp_path / "count.txt").read_text() == "12"


def test_its_settings_are_checked_like_all_others(tmp_path, plugin):
    with pytest.raises(UserError, match=r"count.times: want a whole number, got 'two'"):
        context(tmp_path, "+count={_target_: my_task.Count, times: two}", "stages=[count]")


def test_an_unknown_stage_is_one_line_with_those_that_there_are(tmp_path, plugin):
    with pytest.raises(UserError) as caught:
        context(tmp_path, "+count={_target_: my_task.Count}", "stages=[views,fields]")
    known = "views, field, target_sets, warm_start, psi, evaluate, report"
    more = "preflight, repeat, predict, export, box, viewer, doctor, count"
    assert str(caught.value) == f"stages: unknown stage 'fields', want some of {known}, {more}"


def test_a_task_that_finds_a_failure_makes_the_exit_status_one(tmp_path, plugin):
    arguments = ["+fail={_target_: my_task.Fail}", "stages=[fail]", f"hydra.run.dir={tmp_path}/run"]
    command = [sys.executable, "-m", "src.main", *arguments]
    places = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": places}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "Traceback" not in done.stderr
