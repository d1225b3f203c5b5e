"""The store finds what was made, makes what was not, survives damage, and lets one process make at a time."""

import errno
import hashlib
import io
import multiprocessing
import os
import signal
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from random import Random

import pytest
import torch

from neural_sim.stages.store import Store, _header


def fetch(store, make, key="a"):
    return store.fetch("field", key, {"key": key}, make)


def test_made_once_then_found(tmp_path):
    store, calls = Store(tmp_path), []

    def make():
        calls.append(1)
        return {"x": torch.arange(3)}

    first, second = fetch(store, make), fetch(store, make)
    assert len(calls) == 1 and not first.reused and second.reused
    assert torch.equal(second.value["x"], torch.arange(3))
    assert second.seconds == first.seconds
    fetch(store, make, "b")
    assert len(calls) == 2


def _saved(content):
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _summed(content):
    """An entry whose hash fits, of other content."""
    payload = _saved(content)
    return _header(hashlib.sha256(payload).hexdigest(), len(payload)) + payload


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (b"half written", "no checksum"),
        (b"", "no checksum"),
        (b"\x80\x04N.", "no checksum"),
        (_saved({"value": 1, "seconds": 1.0}), "no checksum, like entries of older versions"),
        (_summed([1]), "holds a list"),
        (_summed(3.0), "holds a float"),
        (_summed(torch.zeros(2)), "holds a Tensor"),
        (_summed({"value": 1}), "holds a dict, want value and seconds"),
        (_summed({"value": Path("a"), "seconds": 1.0}), "holds something other than tensors"),
        (_header(hashlib.sha256(b"").hexdigest(), 0), "cannot be read"),
    ],
)
def test_a_damaged_entry_is_set_aside_and_made_again(tmp_path, caplog, damage, why):
    store = Store(tmp_path)
    fetch(store, lambda: 1)
    path = tmp_path / "field" / "a.pt"
    path.write_bytes(damage)
    assert fetch(store, lambda: 2).value == 2
    assert fetch(store, lambda: 3).value == 2
    assert path.with_name("a.damaged").read_bytes() == damage
    (record,) = caplog.records
    assert record.levelname == "WARNING" and "\n" not in record.getMessage()
    assert why in record.getMessage() and "made again" in record.getMessage()


def test_a_folder_in_the_place_of_an_entry_is_set_aside(tmp_path):
    (tmp_path / "field" / "a.pt").mkdir(parents=True)
    assert fetch(Store(tmp_path), lambda: 2).value == 2
    assert (tmp_path / "field" / "a.damaged").is_dir()


SHAPES = {
    "tensors": {
        "field": {"kind": "grid", "state": {"w": torch.linspace(0, 1, 300)}},
        "history": [{"psnr": 1.5}],
    },
    "images": torch.arange(768, dtype=torch.uint8).reshape(1, 3, 16, 16),
    "list": [torch.ones(3), "names", None, 2],
    "number": 0.25,
    "text": "one",
    "mapping": {"ap": [0.5, 0.25], "labels": torch.tensor([1, 2])},
}


def _flip(content, random):
    place, bit = random.randrange(len(content)), random.randrange(8)
    return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def _truncate(content, random):
    return content[: random.randrange(len(content))]


def _append(content, random):
    return content + random.randbytes(random.randrange(1, 9))


def _clear(content, random):
    place, size = random.randrange(len(content) - 64), random.randrange(64, 512)
    return content[:place] + b"\0" * len(content[place : place + size]) + content[place + size :]


@pytest.mark.parametrize(("change", "times"), [(_flip, 300), (_truncate, 100), (_append, 20), (_clear, 100)])
def test_no_damage_is_used(tmp_path, caplog, change, times):
    store, random = Store(tmp_path), Random(0)
    for key, value in SHAPES.items():
        fetch(store, lambda value=value: value, key)
    whole = {key: (tmp_path / "field" / f"{key}.pt").read_bytes() for key in SHAPES}
    damaged = 0
    for _ in range(times):
        key = random.choice(list(SHAPES))
        path = tmp_path / "field" / f"{key}.pt"
        content = change(whole[key], random)
        damaged += content != whole[key]  # a block may have been zero before
        path.write_bytes(content)
        assert fetch(store, lambda: "again", key).reused == (content == whole[key])
        assert len(caplog.records) == damaged
    assert damaged > 0.9 * times


def test_what_killed_runs_left_is_removed_where_no_run_writes(tmp_path, other):
    folder = tmp_path / "field"
    other(tmp_path, 600, "c")
    for name in (".a.pt.x1y2", ".a.json.x1y2", ".b.pt.x1y2", ".c.pt.x1y2", ".c.json.x1y2"):
        (folder / name).write_bytes(b"half")
    fetch(Store(tmp_path), lambda: 1)
    assert {path.name for path in folder.glob(".*")} == {".c.pt.x1y2", ".c.json.x1y2"}


def test_entries_have_the_permissions_of_new_files(tmp_path):
    before = os.umask(0o007)
    try:
        fetch(Store(tmp_path), lambda: 1)
    finally:
        os.umask(before)
    modes = {path.suffix: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "field").iterdir()}
    assert modes == {".pt": 0o660, ".json": 0o660, ".lock": 0o660}


def test_a_store_that_cannot_be_written_is_a_users_error(tmp_path):
    (tmp_path / "field").write_text("a file")
    with pytest.raises(ValueError, match=r"paths\.store: .*field.* cannot be written"):
        fetch(Store(tmp_path), lambda: 1)


def test_a_failed_make_leaves_nothing_and_frees_the_lock(tmp_path):
    with pytest.raises(RuntimeError):
        fetch(Store(tmp_path), lambda: (_ for _ in ()).throw(RuntimeError("no")))
    assert not list(tmp_path.rglob("*.pt"))
    assert fetch(Store(tmp_path), lambda: 3).value == 3


@dataclass(frozen=True)
class Stand:
    """A dataclass in a state."""

    value: torch.Tensor
    parts: tuple[int, ...] = ()


def _resumed(store, classes=(Stand,)):
    """Make an entry that notes where it stands, and return where it found the work."""
    found = []

    def make():
        found.append(store.state("field", "a", classes))
        store.keep("field", "a", {"at": 7, "stand": Stand(torch.arange(3), (1, 2))})
        raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        fetch(store, make)
    return found[0]


def test_unfinished_work_is_found_until_its_result_stands(tmp_path):
    store = Store(tmp_path)
    assert _resumed(store) is None
    state = _resumed(store)
    assert state["at"] == 7 and state["stand"].parts == (1, 2)
    assert torch.equal(state["stand"].value, torch.arange(3))
    assert store.audit().checkpoints == [tmp_path / "field" / "a.checkpoint"]
    fetch(store, lambda: 1)
    assert store.state("field", "a") is None and not store.audit().checkpoints


def test_processes_that_write_one_state_lose_nothing_of_each_other(tmp_path):
    store, run = Store(tmp_path), ThreadPoolExecutor(8)
    list(run.map(lambda n: store.revise("export", "a", lambda state: {**(state or {}), str(n): n}), range(8)))
    assert store.state("export", "a") == {str(n): n for n in range(8)}
    store.revise("export", "a", lambda state: None)
    assert store.state("export", "a") is None and not store.audit().checkpoints


def test_a_state_that_cannot_be_revised_costs_a_warning(tmp_path, caplog):
    (tmp_path / "export").write_text("no folder")
    Store(tmp_path).revise("export", "a", lambda state: {"at": 1})
    (record,) = caplog.records
    assert "cannot be written" in record.getMessage() and "the work goes on" in record.getMessage()


@pytest.mark.parametrize("change", [_flip, _truncate, _clear, None])
def test_a_damaged_checkpoint_is_set_aside_and_the_work_starts_again(tmp_path, caplog, change):
    store, path = Store(tmp_path), tmp_path / "field" / "a.checkpoint"
    _resumed(store)
    if change is not None:
        path.write_bytes(change(path.read_bytes(), Random(1)))
    # A class that the reader does not expect may run code when it is made.
    assert _resumed(store, (Stand,) if change else ()) is None
    (record,) = caplog.records
    assert f"{path} is damaged" in record.getMessage() and "starts again" in record.getMessage()
    assert (tmp_path / "field" / "a.checkpoint.damaged").is_file()
    assert _resumed(store)["at"] == 7


def test_a_checkpoint_that_cannot_be_written_costs_a_warning(tmp_path, monkeypatch, caplog):
    store = Store(tmp_path)

    def make():
        with monkeypatch.context() as patch:
            patch.setattr("torch.save", full_disk)
            store.keep("field", "a", {"at": 1})
        return 5

    assert fetch(store, make).value == 5
    (record,) = caplog.records
    assert "a.checkpoint cannot be written: No space left on device; the work goes on" in record.getMessage()
    assert {path.name for path in (tmp_path / "field").iterdir()} == {"a.pt", "a.json", "a.lock"}


def test_a_result_that_cannot_be_written_leaves_earlier_ones_and_the_checkpoint(tmp_path, monkeypatch):
    store = Store(tmp_path)
    fetch(store, lambda: 1, "b")

    def make():
        store.keep("field", "a", {"at": 1})
        monkeypatch.setattr("torch.save", full_disk)
        return 5

    with pytest.raises(
        ValueError, match=r"^paths\.store: .*a\.pt cannot be written: No space left on device$"
    ):
        fetch(store, make)
    assert {path.name for path in (tmp_path / "field").iterdir() if path.suffix != ".lock"} == {
        "a.json", "a.checkpoint", "b.pt", "b.json",
    }  # fmt: skip
    assert store.state("field", "a")["at"] == 1 and fetch(store, lambda: 2, "b").value == 1


LIMITED = """
import resource, signal, sys, torch
from pathlib import Path
from neural_sim.stages.store import Store
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    Store(Path(sys.argv[1])).fetch("field", "a", {}, lambda: {"x": torch.zeros(250_000)})
except ValueError as error:
    print(error)
"""


def test_a_system_that_lets_no_more_be_written_is_told_as_such(tmp_path):
    """Not by a stub: torch hides what the system said in an error of its own."""
    told = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert (
        told.stdout == f"paths.store: {tmp_path}/field/a.pt cannot be written: File too large\n" + told.stderr
    )
    assert not list(tmp_path.rglob("*.pt*"))


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _slow(folder, begun, seconds, key):
    def make():
        (folder / f"made by {os.getpid()}").touch()
        begun.set()
        time.sleep(seconds)
        return os.getpid()

    fetch(Store(folder), make, key)


@pytest.fixture
def other():
    """A process that makes an entry, begun when the test goes on."""
    context, processes = multiprocessing.get_context("fork"), []

    def start(folder, seconds, key="a"):
        begun = context.Event()
        processes.append(context.Process(target=_slow, args=(folder, begun, seconds, key)))
        processes[-1].start()
        assert begun.wait(20)
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.join()


def test_two_processes_never_make_one_entry_twice(tmp_path, other):
    process = other(tmp_path, 0.5)
    entry = fetch(Store(tmp_path), lambda: pytest.fail("made twice"))
    assert entry.reused and entry.value == process.pid
    assert len(list(tmp_path.glob("made by *"))) == 1


def test_a_killed_maker_blocks_nobody(tmp_path, other):
    process = other(tmp_path, 600)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    begun = time.monotonic()
    assert fetch(Store(tmp_path), lambda: "again").value == "again"
    assert time.monotonic() - begun < 10


def test_entries_of_one_kind_do_not_wait_for_each_other(tmp_path, other):
    other(tmp_path, 600)
    assert fetch(Store(tmp_path), lambda: 1, "b").value == 1
