"""The loop of checked steps: what is trained on, under which random numbers, and what is differentiated."""

import itertools
from dataclasses import replace

import pytest
import torch
from small_loop import EVERY_STEP, checked_loop, scored_by, small_loop, watch

from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer import descent
from neural_sim.outer.certificate import Trust, certify
from neural_sim.outer.descent import learned_objects
from neural_sim.outer.inner import InnerLoop, Trained
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.outer.trust_region import TrustRegion


def test_checked_trainings_differ_by_psi_alone(scene):
    module = checked_loop(scene)
    inner, numbers = module.inner, module.numbers
    psi = torch.zeros(2, 4)
    first, second = (inner.draw(psi, numbers).images.images for _ in range(2))
    assert torch.equal(first, second)
    moved = inner.draw(torch.tensor([[0.0] * 4, [5.0, 0.0, 0.0, 0.0]]), numbers).images.images
    assert torch.equal(moved[:6], first[:6]) and not torch.equal(moved[6:], first[6:])
    one, other = (inner.train(psi, numbers).trainable for _ in range(2))
    assert all(torch.equal(one[name], value) for name, value in other.items())
    assert not torch.equal(inner.draw(psi, numbers.renewed()).images.images, first)


def test_methods_that_are_not_checked_get_new_random_numbers(scene):
    module = small_loop(scene, StratifiedEstimator(probes_per_bin=2), pool_per_bin=2)
    first, second = (module.inner.draw(torch.zeros(2, 4), module.numbers).images.images for _ in range(2))
    assert not torch.equal(first, second)


def test_a_checked_loop_reports_what_its_last_training_accepted(scene):
    module = checked_loop(scene)
    learned = learn_psi(module)
    first, middle, last = learned.records
    assert first.verdicts == {} and first.certificate and middle.certificate
    # The last training judges and takes no derivative.
    assert last.certificate is None and "hypergradient" not in last.seconds
    assert set(middle.verdicts) == {"a", "b"} and set(last.verdicts) <= {"a", "b"}

    def pose(psi):
        return module.scene.distribution.probabilities(psi)["pose"]

    start, *tried = (pose(psi) for psi in learned.trajectory)
    assert bool((tried[0] != start).any(1).all())  # not judged yet
    # An iteration's derivative is that at the psi which its verdicts accepted, and so is the result.
    accepted = start
    after = (middle.probabilities["pose"], pose(learned.last))
    for record, step, result in zip((middle, last), tried, after, strict=False):
        rose = [name in record.verdicts and record.verdicts[name].accepted for name in ("a", "b")]
        accepted = torch.where(torch.tensor(rose)[:, None], step, accepted)
        torch.testing.assert_close(torch.as_tensor(result, dtype=torch.float64), accepted)
    torch.testing.assert_close(torch.tensor(last.probabilities["pose"], dtype=torch.float64), tried[1])


def test_a_record_tells_the_step_that_waited_from_the_one_that_was_taken(scene):
    learned = learn_psi(checked_loop(scene, steps=replace(EVERY_STEP, waits_below=1.0)))
    first, second, _ = learned.records
    assert first.certificate
    actions = {name: by_factor["pose"] for name, by_factor in first.certificate.actions.items()}
    assert sorted(actions.values()) == ["kept", "waited"]
    assert [name for name, action in actions.items() if action == "kept"] == list(second.verdicts)


def test_a_step_is_judged_under_the_numbers_of_its_derivative_and_the_next_one_has_others(scene, monkeypatch):
    module = checked_loop(scene, steps=replace(EVERY_STEP, trainings=2))
    calls, psis = watch(monkeypatch, InnerLoop, "train"), []
    train_on = module.train_on

    def noted(psi, recording=None):
        psis.append(psi.detach().clone())
        return train_on(psi, recording)

    module.train_on = noted
    learned = learn_psi(module)
    trained = [(numbers.index, recording is not None) for _, (_, numbers, _, recording), _ in calls]
    # Two derivatives before the first step; then a verdict and a derivative an iteration; then a verdict.
    assert trained == [(0, True), (1, True), (1, False), (2, True), (2, False)]
    start, again, tried, accepted, last = psis
    assert torch.equal(start, again) and bool((tried != start).any(1).all())
    assert torch.equal(tried, learned.trajectory[1]) and torch.equal(last, learned.trajectory[2])
    rose = [learned.records[1].verdicts[name].accepted for name in ("a", "b")]
    assert torch.equal(accepted, torch.where(torch.tensor(rose)[:, None], tried, start))
    assert not torch.equal(last, accepted)
    # Both derivatives of the first iteration are charged.
    assert learned.records[0].products == 2 * learned.records[1].products > 0


def test_derivatives_are_of_one_half_of_the_validation_images_after_the_other(scene, monkeypatch):
    module = checked_loop(scene, 4, steps=replace(EVERY_STEP, trainings=2))
    calls = watch(monkeypatch, SimulatorModule, "_derivative")
    learn_psi(module)
    seen = [objective.images.images for _, (_, objective), _ in calls]
    assert [len(part) for part in seen] == [3] * 4
    for first, second in (seen[:2], seen[2:]):
        both = torch.cat([first, second]).flatten(1)
        assert (
            len(both.unique(dim=0)) == len(module.inner.objective.images.images.flatten(1).unique(dim=0)) == 6
        )


def test_a_certified_derivative_is_of_all_validation_images_as_its_reference_is(scene, monkeypatch):
    module = checked_loop(scene, 3, steps=replace(EVERY_STEP, trainings=2), certify_every=2)
    calls = watch(monkeypatch, SimulatorModule, "_derivative")
    learn_psi(module)
    assert [len(objective.images) for _, (_, objective), _ in calls] == [3, 3, 6]


def test_a_loop_whose_steps_never_help_ends_where_it_began(scene, monkeypatch):
    module = checked_loop(scene)
    falling = iter(range(10))
    scores = property(lambda trained: torch.full((2, 6), -float(next(falling))))
    monkeypatch.setattr(Trained, "scores", scores)
    learned = learn_psi(module)
    assert any(record.verdicts for record in learned.records)
    assert not any(v.accepted for record in learned.records for v in record.verdicts.values())
    assert torch.equal(learned.last, learned.trajectory[0])


@pytest.mark.parametrize("bad", [{"train_first": False}, {"start": "previous"}, {"epochs": 0}])
def test_checked_steps_want_trainings_that_can_be_compared(scene, bad):
    with pytest.raises(ValueError, match="outer"):
        Outer(**bad)


def test_objects_that_validation_does_not_show_keep_their_psi(scene, caplog):
    module = checked_loop(scene, shown=slice(3, 6))
    assert "so their psi stays as it is: a" in caplog.text
    learned = learn_psi(module)
    assert not learned.last[0].any() and set(learned.records[1].verdicts) == {"b"}
    assert all(set(record.certificate.actions) == {"b"} for record in learned.records[:2])
    caplog.clear()
    asked = checked_loop(scene, shown=slice(3, 6), learned=("a", "b"))
    assert asked.objects.names == ["b"] and "so their psi stays as it is: a" in caplog.text
    free = small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), pool_per_bin=2, shown=slice(3, 6), learned=("a", "b")
    )
    assert free.objects.names == ["a", "b"]


def test_validation_without_an_object_is_refused(scene):
    module = checked_loop(scene)
    images = module.inner.objective.images
    empty = replace(images, labels=torch.full_like(images.labels, -1))
    objective = replace(module.inner.objective, images=empty)
    with pytest.raises(ValueError, match="show none of the objects"):
        learned_objects(replace(module.inner, objective=objective))


def test_a_loop_ends_after_iterations_in_which_nothing_is_tried(scene):
    """At so strict a level no derivative is significant."""
    learned = learn_psi(checked_loop(scene, 6, patience=2, trust=Trust(level=0.001)))
    assert len(learned.records) == 2 and not any(record.verdicts for record in learned.records)
    assert torch.equal(learned.last, learned.trajectory[0])
    tried = learn_psi(checked_loop(scene, 3, patience=1))
    assert len(tried.records) == 3 and tried.records[1].verdicts


def test_iterations_in_which_nothing_is_tried_end_a_loop_only_one_after_the_other(scene, monkeypatch):
    """In every other iteration no derivative is significant; two in a row would end the loop."""
    levels = itertools.cycle([0.001, None])
    monkeypatch.setattr(
        descent, "certify", lambda *given: certify(*given[:4], Trust(level=next(levels)), *given[5:])
    )
    learned = learn_psi(checked_loop(scene, 5, patience=2))
    tried = [bool(record.verdicts) for record in learned.records]
    assert tried == [False, False, True, False, True]


def test_the_score_after_a_rejected_step_is_not_that_of_the_psi_before_it(scene, monkeypatch):
    module = checked_loop(scene)
    scored_by(monkeypatch, lambda psi: -psi.any(1).double())
    learned = learn_psi(module)
    assert [verdict.accepted for verdict in learned.records[1].verdicts.values()] == [False, False]
    assert all(len(stays) == 1 and set(stays[0].scores) == {0.0} for stays in module._way.stays.values())


def test_a_loop_returns_the_best_psi_on_the_way(scene, monkeypatch):
    """Every training that judges a step finds a small gain; those of the derivatives find that psi is ever worse."""
    module = checked_loop(scene, 4, steps=TrustRegion())
    falls, last = {}, [1.0]

    def score(trained):
        if trained.trajectory is None:
            return last[0] + 0.01
        last[0] = falls.setdefault(tuple(trained.psi.flatten().tolist()), 1.0 - 0.3 * len(falls))
        return last[0]

    monkeypatch.setattr(
        Trained, "scores", property(lambda t: torch.full((2, 6), score(t) / 6, dtype=torch.float64))
    )
    learned = learn_psi(module)
    taken = learned.records[-1].taken_back
    assert set(taken) == {"a", "b"} and all(back.kept == 0 < back.accepted for back in taken.values())
    assert torch.equal(learned.last, learned.trajectory[0])
    assert all(not record.taken_back for record in learned.records[:-1])
