"""Seconds go to the innermost phase; what the store had is noted."""

import pytest

from neural_sim.stages import account as module
from neural_sim.stages.account import Account, Omission


def test_seconds_go_to_the_innermost_phase(monkeypatch):
    clock = iter([0.0, 1.0, 4.0, 9.0, 100.0, 102.0])
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(clock))
    account = Account()
    with account.charged("psi"), account.charged("field"):
        pass
    with pytest.raises(RuntimeError), account.charged("psi"):
        raise RuntimeError
    assert account.seconds == {"psi": 1.0 + 5.0 + 2.0, "field": 3.0}


def test_a_phase_inside_itself_counts_once(monkeypatch):
    clock = iter([0.0, 1.0, 3.0, 6.0])
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(clock))
    account = Account()
    with account.charged("field"), account.charged("field"):
        pass
    assert account.seconds == {"field": 6.0}


def test_what_the_store_had_is_noted():
    account = Account()
    account.reused("psi", "psi loop", 12.5)
    assert account.left_out == [Omission("psi", "psi loop", "found in the store", 1.0, 12.5)]
