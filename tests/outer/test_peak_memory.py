"""The most memory at one time, of allocations whose sizes are known."""

import torch

from neural_sim.outer.peak_memory import peak_bytes

MB = 2**20


def _floats(megabytes):
    return torch.empty(megabytes * MB // 4)


def test_memory_that_is_given_back_does_not_add_up():
    def run():
        for size in (1, 4, 2):
            _floats(size)

    assert peak_bytes(run) == 4 * MB


def test_memory_that_is_kept_adds_up_until_it_is_given_back():
    def run():
        first, second = _floats(2), _floats(3)
        del first
        third = _floats(1)
        return second, third

    assert peak_bytes(run) == 5 * MB


def test_what_was_there_before_does_not_count():
    before = _floats(8)
    assert peak_bytes(lambda: before.add_(1.0).new_empty(MB)) == 4 * MB
