"""Where a run computes."""

import pytest
import torch
from trips import counted

from neural_sim import devices

MB = 2**20


def test_a_gpu_that_is_not_there_is_refused_with_the_key(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)  # nor is one that is there, for this test
    with pytest.raises(ValueError, match="trainer=gpu: torch finds no cuda device"):
        devices.device_of("gpu")
    with pytest.raises(ValueError, match=r"trainer\.accelerator"):
        devices.device_of("tpu")
    assert devices.device_of("cpu") == torch.device("cpu")


def test_one_place_chooses_the_device(pretend, monkeypatch):
    monkeypatch.setitem(devices.DEVICES, "gpu", "pretend")
    device = devices.device_of("gpu")
    trainer = devices.trainer_on(device)
    assert device == torch.device("pretend", 0) and trainer.strategy.root_device == device


@pytest.fixture
def tf32():
    """TF32 allowed for a test; torch's default for cuDNN."""
    backends = (torch.backends.cudnn, torch.backends.cuda.matmul)
    before = [backend.allow_tf32 for backend in backends]
    for backend in backends:
        backend.allow_tf32 = True
    yield backends
    for backend, allowed in zip(backends, before, strict=True):
        backend.allow_tf32 = allowed


def test_a_gpu_convolves_and_multiplies_in_float32(monkeypatch, tf32):
    """The loop's central differences of losses need digits that TF32 does not have."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert devices.device_of("gpu") == torch.device("cuda", 0)
    assert not any(backend.allow_tf32 for backend in tf32)


def test_many_small_tensors_move_in_one_copy(pretend):
    parts = [torch.arange(6.0).view(2, 3), torch.ones(()), torch.zeros(0, 4)]
    with counted() as ledger:
        there = devices.moved(parts, "pretend")
    assert ledger.count() == 1
    assert all(
        torch.equal(x.cpu(), y) and x.device.type == "pretend" for x, y in zip(there, parts, strict=True)
    )
    assert all(x is y for x, y in zip(devices.moved(parts, "cpu"), parts, strict=True))


def test_a_gpu_is_started_before_its_peak_is_forgotten(monkeypatch):
    """As CUDA does: it has no count to reset before torch has used it."""
    calls = []
    monkeypatch.setattr(torch.cuda, "init", lambda: calls.append("init"))
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: calls.append(device.type))
    devices.forget_gpu_peak(torch.device("cpu"))
    assert not calls
    devices.forget_gpu_peak(torch.device("cuda", 0))
    assert calls == ["init", "cuda"]


def test_memory_of_a_gpu_is_reported_only_where_there_is_one():
    found = devices.peak_memory_mb(torch.device("cpu"))
    assert set(found) == {"peak_memory_mb"} and found["peak_memory_mb"] > 10.0


def _floats(megabytes):
    return torch.empty(megabytes * MB // 4)


def test_memory_that_is_given_back_does_not_add_up():
    def run():
        for size in (1, 4, 2):
            _floats(size)

    assert devices.peak_bytes(run) == 4 * MB


def test_memory_that_is_kept_adds_up_until_it_is_given_back():
    def run():
        first, second = _floats(2), _floats(3)
        del first
        third = _floats(1)
        return second, third

    assert devices.peak_bytes(run) == 5 * MB


def test_what_was_there_before_does_not_count():
    before = _floats(8)
    assert devices.peak_bytes(lambda: before.add_(1.0).new_empty(MB)) == 4 * MB
