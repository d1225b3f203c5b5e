"""``stages=[doctor]``: what is well is said so, and what is not gets one line with what to do, and exit status 1."""

import importlib.metadata
import json
import re
from pathlib import Path

import pytest
import torch
from composing import composed

from neural_sim.main import context_of
from neural_sim.stages.store import Store
from neural_sim.tasks import doctor
from neural_sim.tasks.context import TaskFailure


def findings(tmp_path, *overrides):
    paths = [f"paths.store={tmp_path / 'store'}", f"paths.mlflow={tmp_path / 'mlflow.db'}"]
    config = composed("stages=[doctor]", *paths, *overrides)
    context, tasks = context_of(config, tmp_path)
    try:
        tasks["doctor"].run(context)
        failed = False
    except TaskFailure:
        failed = True
    rows = json.loads((tmp_path / "doctor.json").read_text())
    assert failed == any(row["health"] == "bad" for row in rows)
    return {(row["what"], row["health"]): row for row in rows}


@pytest.fixture(autouse=True)
def _quick(monkeypatch, tmp_path, empty_store):
    """No process for OpenGL, and a database that exists."""
    monkeypatch.setattr(doctor, "opengl_platform", lambda: "egl")
    (tmp_path / "mlflow.db").write_bytes(empty_store.read_bytes())


def entry(tmp_path, key="a"):
    Store(tmp_path / "store").fetch("field", key, {}, lambda: torch.arange(100))
    return tmp_path / "store" / "field" / f"{key}.pt"


def test_a_machine_that_can_work_is_well(tmp_path, capsys):
    entry(tmp_path)
    found = findings(tmp_path, f"paths.data={tmp_path}")
    assert {"packages", "device", "store", "MLflow", "OpenGL"} <= {
        what for what, health in found if health == "ok"
    }
    assert not [what for what, health in found if health == "bad"]
    assert "1 results" in found["store", "ok"]["found"] and found["data", "note"]["advice"]
    assert "| ok | device | cpu |" in capsys.readouterr().out


def test_a_flipped_bit_in_a_result_is_found(tmp_path):
    path = entry(tmp_path)
    content = bytearray(path.read_bytes())
    content[-30] ^= 4
    path.write_bytes(content)
    entry(tmp_path, "b")
    found = findings(tmp_path)
    assert str(path) in found["results in the store", "bad"]["found"]
    assert "1 results" in found["store", "ok"]["found"] and path.read_bytes() == content


def test_what_killed_runs_left_is_counted(tmp_path):
    path = entry(tmp_path)
    path.with_name(".b.pt.0123abcd").write_bytes(b"half")
    path.with_name("c.damaged").write_bytes(b"set aside")
    path.with_name("d.checkpoint").write_bytes(b"unfinished")
    found = findings(tmp_path)
    assert found["results in the store", "note"]["found"].startswith("2 files")
    assert found["checkpoints in the store", "note"]["found"].startswith("1 of unfinished work")


def test_a_store_that_is_a_file_is_bad(tmp_path):
    (tmp_path / "store").write_text("no folder")
    assert "is a file" in findings(tmp_path)["store", "bad"]["found"]


def test_a_database_that_is_none_is_bad(tmp_path):
    (tmp_path / "mlflow.db").write_text("no database, but a text of some length\n" * 100)
    assert findings(tmp_path)["MLflow", "bad"]["found"]


def test_packages_that_are_missing_or_too_old_are_bad(monkeypatch):
    wanted = ["torch>=99", "no-such-package>=1", "numpy>=1", "viser>=99; extra == 'viewer'"]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: wanted)
    row = next(doctor.packages())
    assert row.health == "bad" and row.advice
    assert (
        "torch" in row.found and "want >=99" in row.found and "no-such-package is not installed" in row.found
    )
    assert "numpy" not in row.found and "viser" not in row.found


def test_little_memory_is_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "_free_memory_gb", lambda: 1.5)
    assert findings(tmp_path)["memory", "note"]["found"] == "1.5 GB free"


def test_cached_files_of_a_container_count_as_free(tmp_path):
    """The container may use 8 GiB and uses 7; the kernel can give 5 of these back, because they only cache files."""
    gib = 2**30
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text(f"MemTotal: {64 * 2**20} kB\nMemAvailable: {32 * 2**20} kB\n")
    assert doctor._free_memory_gb(tmp_path) == 32.0
    (group / "memory.max").write_text(f"{8 * gib}\n")
    (group / "memory.current").write_text(f"{7 * gib}\n")
    (group / "memory.stat").write_text(f"anon {2 * gib}\ninactive_file {5 * gib}\n")
    assert doctor._free_memory_gb(tmp_path) == 6.0
    (group / "memory.max").write_text("max\n")
    assert doctor._free_memory_gb(tmp_path) == 32.0


def test_every_folder_that_an_experiment_reads_is_known(tmp_path):
    texts = [path.read_text() for path in Path("conf").rglob("*.yaml")]
    read = {name for text in texts for name in re.findall(r"\$\{paths\.data\}/(\w+)", text)}
    assert read
    for name in read:
        (tmp_path / name).mkdir()
    assert sorted(next(doctor.data(tmp_path)).found.partition(": ")[2].split(", ")) == sorted(read)


def test_a_check_that_fails_is_what_was_to_be_found(tmp_path, monkeypatch):
    def broken():
        raise OSError("the driver does not answer")

    monkeypatch.setattr(doctor, "opengl_platform", broken)
    assert findings(tmp_path)["OpenGL", "bad"]["found"] == "the driver does not answer"
