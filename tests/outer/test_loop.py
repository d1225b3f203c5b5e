"""The loop of reward methods: rounds, what is counted, and that psi is the method's."""

import itertools
from types import SimpleNamespace

import torch

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.outer.loop import learn_psi


def test_rounds_are_counted_and_the_trajectory_is_the_methods(reward_loop):
    method = LearningToSimulate(rounds=3, samples=2)
    loop = reward_loop(method)
    learned = learn_psi(loop)
    assert len(learned.records) == 2 * method.rounds and len(learned.trajectory) == len(learned.records) + 1
    for record in learned.records:
        assert (record.images, record.detector_steps, record.products) == (12, 3, 0)
        assert record.certificate is None and record.seconds["train"] > 0.0
    assert torch.equal(learned.last, loop.search.psi)
    moved = [not torch.equal(*pair) for pair in itertools.pairwise(learned.trajectory)]
    assert moved == [False, True] * 3  # after every second setting
    assert any(record.probabilities != learned.records[0].probabilities for record in learned.records)


def test_an_observer_sees_each_iteration_when_it_has_ended_at_no_cost_of_the_method(reward_loop, monkeypatch):
    clock, seen = [0.0], []
    loop = reward_loop(LearningToSimulate(rounds=2))

    def observe(record):
        seen.append((record, len(loop.records), len(loop.trajectory)))
        clock[0] += 100.0

    monkeypatch.setattr("neural_sim.outer.loop.time", SimpleNamespace(process_time=lambda: clock[0]))
    learned = learn_psi(loop, on_record=observe)
    assert seen == [(record, i + 1, i + 2) for i, record in enumerate(learned.records)] and len(seen) == 4
    assert [record.cpu_seconds for record in learned.records[1:]] == [0.0] * 3
