"""Independent stages are made by several processes, with the results of one."""

import logging
import os

import pytest
import torch
from number_stages import Number, Sum, entries

from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store
from neural_sim.stages.together import make_together


@pytest.fixture
def results(tmp_path):
    return Results(Store(tmp_path))


def test_two_are_made_at_one_time_and_what_needs_them_afterwards(results, caplog):
    parts = (Number(1, seconds=1.0), Number(2, seconds=1.0))
    both = Number(3, (Sum(0, parts),))
    with caplog.at_level(logging.INFO):
        make_together(results, [both], by=2)
    first, second, last = (results.store.fetch(s.kind, s.key, {}, pytest.fail).value for s in (*parts, both))
    assert first["process"] != second["process"] and os.getpid() not in (first["process"], second["process"])
    assert max(first["begun"], second["begun"]) < min(first["ended"], second["ended"]) <= last["begun"]
    assert results(both)["total"] == 6 and not results._account.left_out
    # Their log is this one's, and their sums have as many threads.
    assert [f"made {n} with {torch.get_num_threads()} threads" in caplog.text for n in (1, 2, 3)] == [
        True
    ] * 3


@pytest.mark.parametrize(
    "stages",
    [[Number(1)], [Number(2, (Number(1),))], [Number(1, hook=lambda: None), Number(2)]],
    ids=["one", "a chain", "one that cannot be sent, and another"],
)
def test_nothing_is_made_where_no_two_go_together(results, stages, tmp_path):
    make_together(results, stages, by=2)
    assert entries(tmp_path) == 0


def test_one_process_makes_nothing_beforehand(results, tmp_path):
    make_together(results, [Number(1), Number(2)], by=1)
    assert entries(tmp_path) == 0


def test_what_needs_a_stage_that_cannot_be_sent_stays_here(results, tmp_path, caplog):
    here = Number(1, hook=lambda: None)
    with caplog.at_level(logging.INFO):
        make_together(results, [Number(4, (here,)), Number(2), Number(3)], by=2)
    assert entries(tmp_path) == 2 and "number 1: made by this process" in caplog.text


def test_an_error_is_that_of_the_stage(results):
    with pytest.raises(ValueError, match=r"^number -1: want at least 0$"):
        make_together(results, [Number(-1), Number(2)], by=2)


def test_a_process_that_is_killed_costs_no_more_than_its_result(results, caplog):
    make_together(results, [Number(666), Number(2)], by=2)
    assert "a process was killed from outside" in caplog.text
    assert results(Number(2))["total"] == 2
