"""A psi loop that is killed in the middle of any iteration goes on after the last one that ended, to the same bits."""

import dataclasses
import logging

import pytest
import torch
from small_loop import CHECKED, small_loop

from neural_sim.baseline.lts import LearningToSimulate
from neural_sim.checkpoint import Checkpoint
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.outer.certificate import Trust
from neural_sim.outer.first_step import FirstStep
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.response import ResponseLoop
from neural_sim.outer.steps import Proposal
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.stages.psi import _STATE
from neural_sim.stages.store import Store


class Killed(Exception):
    """What ends a run here."""


@pytest.fixture
def interrupted(tmp_path, monkeypatch):
    """Run a loop that ends at its n-th training."""
    store, train = Store(tmp_path), InnerLoop.train
    (tmp_path / "psi").mkdir()

    def checkpoint():
        return Checkpoint(
            lambda: store.state("psi", "a", _STATE), lambda state: store.keep("psi", "a", state)
        )

    def run(make, at):
        left = at

        def counted(*arguments, **options):
            nonlocal left
            left -= 1
            if left < 0:
                raise Killed
            return train(*arguments, **options)

        with monkeypatch.context() as patch:
            patch.setattr(InnerLoop, "train", counted)
            with pytest.raises(Killed):
                learn_psi(make(), checkpoint=checkpoint())

    return run, checkpoint


def _bits(learned):
    """All of a result but times."""
    records = [dataclasses.asdict(record) for record in learned.records]
    for record in records:
        del record["seconds"], record["cpu_seconds"]
    return learned.trajectory.tolist(), str(records), [dataclasses.asdict(one) for one in learned.shown]


class Shifted(FirstStep):
    """Offers a psi that nothing was read for."""

    def propose(self, scene, images, psi, generator):
        return Proposal(psi + torch.rand(psi.shape, generator=generator), torch.full((2,), 0.01), 4)


def _response(scene):
    made = small_loop(scene, ReinforceEstimator(), 3, pool_per_bin=2, **CHECKED)
    return ResponseLoop(made.inner, torch.zeros(2, 4), 0.5, made.numbers.generator)


STEPS = TrustRegion(trainings=1, take_back=True, level=0.9)
LOOPS = {
    "default": lambda scene: small_loop(
        scene, StratifiedEstimator(2), 3, pool_per_bin=2, **{**CHECKED, "steps": STEPS}
    ),
    "first step": lambda scene: small_loop(
        scene, StratifiedEstimator(2), 3, pool_per_bin=2, first=Shifted(), **{**CHECKED, "steps": STEPS}
    ),
    "idle": lambda scene: small_loop(
        scene,
        StratifiedEstimator(2),
        4,
        pool_per_bin=2,
        **{**CHECKED, "steps": STEPS, "patience": 2, "trust": Trust(level=0.001)},
    ),
    "paper": lambda scene: small_loop(scene, StratifiedEstimator(2), 3, start="previous"),
    "response": _response,
}


@pytest.mark.parametrize(
    "kind",
    [pytest.param(name, marks=pytest.mark.slow) if name in ("response", "paper") else name for name in LOOPS],
)
def test_a_loop_that_was_killed_ends_at_the_same_bits(scene, interrupted, kind, caplog):
    run, checkpoint = interrupted
    make, seen = lambda: LOOPS[kind](scene), []
    whole = _bits(learn_psi(make()))
    run(make, {"response": 14, "paper": 1, "idle": 1}.get(kind, 3))  # some iterations have ended
    done = len(checkpoint().read()["records"])
    assert 0 < done < len(whole[0]) - 1
    run(make, 0)  # and once more, in the middle of the next one
    assert len(checkpoint().read()["records"]) == done
    with caplog.at_level(logging.INFO):
        learned = learn_psi(make(), seen.append, checkpoint())
    assert _bits(learned) == whole
    assert seen == learned.records  # what watches the run sees all iterations
    assert f"resuming an interrupted run after round {done}" in caplog.text


def test_a_method_of_rewards_that_was_killed_ends_at_the_same_bits(reward_loop, interrupted):
    run, checkpoint = interrupted

    def make():
        return reward_loop(LearningToSimulate(rounds=3, samples=2))

    whole = _bits(learn_psi(make()))
    for done in (3, 2):  # in the middle of a step's two settings, and after them
        run(make, done)
    assert len(checkpoint().read()["records"]) == 5
    assert _bits(learn_psi(make(), checkpoint=checkpoint())) == whole


def test_a_loop_that_had_ended_is_not_run_again(scene, interrupted, monkeypatch):
    _, checkpoint = interrupted
    whole = _bits(learn_psi(LOOPS["paper"](scene), checkpoint=checkpoint()))
    monkeypatch.setattr(InnerLoop, "train", lambda *_: pytest.fail("trained again"))
    assert _bits(learn_psi(LOOPS["paper"](scene), checkpoint=checkpoint())) == whole
