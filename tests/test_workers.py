"""A cluster works as this process does; a machine that is lost costs nothing, and one that is wrong says so."""

import logging
import os
import threading
import time
from pathlib import Path

import pytest
import torch
from number_stages import Number, Sum

from neural_sim import extras, workers
from neural_sim.stages.experiment import Run
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store
from neural_sim.stages.together import make_together


def _place(folder, **changes):
    mark = folder / ".seen-1"
    mark.touch()
    settings = {"mark": mark, "folder": os.getcwd(), "threads": torch.get_num_threads(), "level": logging.INFO,
                "code": workers._code()}  # fmt: skip
    return workers._Place(**{**settings, **changes})


@pytest.fixture
def logs_kept():
    """The handlers that work in another process replaces."""
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:] = before[0]
    root.setLevel(before[1])


@pytest.mark.usefixtures("logs_kept")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mark": "elsewhere"}, r"^workers=ray: \S+ does not see .*; want a path that all machines share$"),
        ({"code": "other"}, r"^workers=ray: \S+ has another version of neural_sim or of torch$"),
    ],
)
def test_a_machine_that_cannot_do_the_work_says_so(tmp_path, changes, message):
    if "mark" in changes:
        changes = {"mark": tmp_path / "not shared" / ".seen-1"}
    outcome = workers._done(_place(tmp_path, **changes), [], 1)
    assert isinstance(outcome.error, ValueError)
    with pytest.raises(ValueError, match=message):
        raise outcome.error


def test_ray_that_is_not_installed_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ValueError, match=r"^workers=ray: ray not installed; pip install 'neural-sim\[ray\]'$"
    ):
        Run("run", 0, tmp_path, "", workers="ray")


def test_processes_cannot_share_a_gpu_and_a_cluster_can(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="workers: want 1 or ray with trainer=gpu"):
        Run("run", 0, tmp_path, "", "gpu", workers=2)
    monkeypatch.setattr(extras, "missing_of", lambda extra: [])
    assert Run("run", 0, tmp_path, "", "gpu", workers="ray", worker_gpus=0.5).gpus == 0.5
    assert Run("run", 0, tmp_path, "", "cpu", workers="ray").gpus == 0.0


@pytest.mark.slow
def test_a_cluster_makes_what_does_not_depend_on_each_other_at_one_time(ray_cluster, tmp_path, caplog):
    results = Results(Store(tmp_path))
    parts = (Number(1, seconds=3.0), Number(2, seconds=3.0))
    both = Number(3, (Sum(0, parts),))
    with caplog.at_level(logging.INFO):
        make_together(results, [both], "ray")
    first, second, last = (results.store.fetch(s.kind, s.key, {}, pytest.fail).value for s in (*parts, both))
    assert first["process"] != second["process"] and os.getpid() not in (first["process"], second["process"])
    assert max(first["begun"], second["begun"]) < min(first["ended"], second["ended"]) <= last["begun"]
    assert results(both)["total"] == 6 and not results._account.left_out
    threads = torch.get_num_threads()
    assert all(f"made {n} with {threads} threads" in caplog.text for n in (1, 2, 3))
    assert not list(tmp_path.glob(".seen*"))


@pytest.mark.slow
def test_an_error_on_a_cluster_is_that_of_the_stage(ray_cluster, tmp_path):
    with pytest.raises(ValueError, match=r"^number -1: want at least 0$"):
        make_together(Results(Store(tmp_path)), [Number(-1), Number(2)], "ray")


@pytest.mark.slow
def test_work_that_ends_every_worker_is_left_to_this_process(ray_cluster, tmp_path, caplog):
    results = Results(Store(tmp_path))
    make_together(results, [Number(666), Number(2)], "ray")
    assert "workers of the cluster were lost" in caplog.text and "the rest is made one by one" in caplog.text
    assert results(Number(2))["total"] == 2


@pytest.mark.slow
def test_a_cluster_without_a_gpu_is_refused_for_one(ray_cluster, tmp_path):
    with pytest.raises(ValueError, match=r"^workers=ray: no machine of the cluster has a GPU"):
        make_together(Results(Store(tmp_path)), [Number(1), Number(2)], "ray", 0.25)


@pytest.mark.slow
def test_a_machine_that_is_lost_costs_nothing(ray_cluster, tmp_path):
    """One of four machines is killed while each makes a number: another one makes that number again."""
    results, begun = Results(Store(tmp_path / "store")), tmp_path / "begun"
    numbers = [Number(value, seconds=4.0, begun=begun) for value in range(1, 7)]
    lost = ray_cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)

    (raylet,) = lost.all_processes["raylet"]

    def lose() -> None:
        while raylet.process.pid not in {_parent(pid) for _, pid in _lines(begun)}:
            time.sleep(0.05)
        ray_cluster.remove_node(lost, allow_graceful=False)

    losing = threading.Thread(target=lose)
    losing.start()
    make_together(results, numbers, "ray")
    losing.join()
    assert [results(number)["total"] for number in numbers] == [1, 2, 3, 4, 5, 6]
    again = [value for value, _ in _lines(begun)]
    assert len(again) == 7 and len(set(again)) == 6
    assert not results._account.left_out  # all were made by this run, none by this process
    assert os.getpid() not in {results(number)["process"] for number in numbers}


def _lines(begun):
    """The values that were begun, and the processes that began them."""
    return [line.split() for line in begun.read_text().splitlines()] if begun.exists() else []


def _parent(pid):
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return None
