"""The store finds what was made, makes what was not, survives damage, and lets one process make at a time."""

import multiprocessing
import os
import signal
import time

import pytest
import torch

from neural_sim.stages.store import Store


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


@pytest.mark.parametrize("damage", [b"half written", b"", b"\x80\x04N."])
def test_a_damaged_entry_is_made_again(tmp_path, caplog, damage):
    store = Store(tmp_path)
    fetch(store, lambda: 1)
    (tmp_path / "field" / "a.pt").write_bytes(damage)
    assert fetch(store, lambda: 2).value == 2
    assert "made again" in caplog.text


def test_a_failed_make_leaves_nothing_and_frees_the_lock(tmp_path):
    with pytest.raises(RuntimeError):
        fetch(Store(tmp_path), lambda: (_ for _ in ()).throw(RuntimeError("no")))
    assert not list(tmp_path.rglob("*.pt"))
    assert fetch(Store(tmp_path), lambda: 3).value == 3


def _slow(folder, begun, seconds):
    def make():
        (folder / f"made by {os.getpid()}").touch()
        begun.set()
        time.sleep(seconds)
        return os.getpid()

    fetch(Store(folder), make)


@pytest.fixture
def other():
    """A process that makes an entry, begun when the test goes on."""
    context, processes = multiprocessing.get_context("fork"), []

    def start(folder, seconds):
        begun = context.Event()
        processes.append(context.Process(target=_slow, args=(folder, begun, seconds)))
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
