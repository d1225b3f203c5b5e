"""The loop of checked steps: what is trained on, under which random numbers, and what is differentiated."""

import itertools
from dataclasses import dataclass, field, replace

import pytest
import torch
from small_loop import CHECKED, EVERY_STEP, small_loop

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer import descent
from neural_sim.outer.certificate import Trust, certify
from neural_sim.outer.descent import learned_objects
from neural_sim.outer.first_step import read_objects
from neural_sim.outer.inner import InnerLoop, Numbers, Trained
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps, Proposal
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.outer.way import Way


def checked_loop(scene, iterations=3, **outer):
    return small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), iterations, pool_per_bin=2, **(CHECKED | outer)
    )


def watch(monkeypatch, cls, name):
    """The arguments of every call of a method, which is called all the same."""
    calls, original = [], getattr(cls, name)

    def watched(self, *arguments, **keywords):
        calls.append((self, arguments, keywords))
        return original(self, *arguments, **keywords)

    monkeypatch.setattr(cls, name, watched)
    return calls


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


SHOWN = (
    FactorEstimate(
        "a", "pose", 9, (0.25,) * 4, (0.85, 0.05, 0.05, 0.05), (0.7, 0.0, 0.0, 0.0), (0.9, 0.1, 0.1, 0.1),
        ((1,), (2,), (3,), (4,)), 0.005, 0.05, 0.9, "moves",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Fake:
    """A first step that proposes a given psi, and notes what it was given."""

    psi: torch.Tensor
    p_values: tuple[float, ...] = (1e-3, 1e-3)
    given: list = field(default_factory=list)
    seeds: list = field(default_factory=list)
    shown: tuple[FactorEstimate, ...] = SHOWN

    def propose(self, scene, images, psi, generator):
        self.given.append((scene, images, psi))
        self.seeds.append(generator.initial_seed())
        return Proposal(self.psi, torch.tensor(self.p_values), images=7, shown=self.shown)


THERE = torch.tensor([[3.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0]])


def scored_by(monkeypatch, worth):
    """Let trainings score what ``worth`` says of their psi [objects, K], alike in every validation image."""
    scores = property(lambda trained: worth(trained.psi).double()[:, None].expand(2, 6) / 6)
    monkeypatch.setattr(Trained, "scores", scores)


def test_the_first_step_is_judged_by_a_training_object_by_object(scene, monkeypatch):
    """The proposal is right of the first object and wrong of the second; derivatives then start where it is right."""
    first = Fake(THERE)
    module = checked_loop(scene, first=first)
    scored_by(monkeypatch, lambda psi: torch.stack([psi[0, 0], -psi[1, 1]]))
    where, train_on = [], module.train_on

    def noted(psi, recording=None):
        where.append((psi.detach().clone(), module.numbers.index))
        return train_on(psi, recording)

    module.train_on = noted
    learned = learn_psi(module)
    (drawn_from, images, psi), record = first.given[0], learned.records[0]
    assert len(first.given) == 1 and drawn_from is module.inner.pool and not psi.any()
    assert images is module.inner.objective.images
    assert {name: v.accepted for name, v in record.verdicts.items()} == {"a": True, "b": False}
    assert learned.shown == SHOWN and "first_step" in record.seconds
    right = torch.stack([THERE[0], torch.zeros(4)]).double()
    # The start and the proposal have their random numbers in common, the derivative has others.
    assert [index for _, index in where[:3]] == [0, 0, 1]
    for (psi, _), wanted in zip(where[1:3], (THERE.double(), right), strict=True):
        torch.testing.assert_close(psi, wanted)
    assert (
        record.images == 7 + 4 * 12 + 4 * 2 + 4
    )  # the estimate's, four trainings', b's probes of two trials, half of which are new in the second


def test_a_first_step_that_is_wrong_is_taken_back_and_the_loop_goes_on(scene, monkeypatch):
    plain = learn_psi(checked_loop(scene))
    wrong = checked_loop(scene, first=Fake(THERE))
    original = Trained.scores
    monkeypatch.setattr(
        Trained, "scores", property(lambda t: original.fget(t) - float(t.psi.abs().max() == 3.0))
    )
    learned = learn_psi(wrong)
    assert not any(verdict.accepted for verdict in learned.records[0].verdicts.values())
    assert learned.records[0].certificate and learned.records[1].verdicts
    assert len(learned.records) == len(plain.records)
    assert not torch.equal(learned.trajectory[1], learned.trajectory[0])  # the derivative's step


def test_a_first_step_shares_no_random_numbers_with_the_trainings_that_judge_it(scene, monkeypatch):
    module = checked_loop(scene, 2, first=(first := Fake(THERE)))
    shared = watch(monkeypatch, Numbers, "of")
    learn_psi(module)
    taken = {numbers.of(purpose).initial_seed() for numbers, (purpose,), _ in list(shared)}
    assert taken and len(first.seeds) == 1 and first.seeds[0] not in taken


@pytest.mark.parametrize("iterations", [1, 2])
@pytest.mark.parametrize("psi", [torch.zeros(2, 4), THERE], ids=["uniform", "biased"])
def test_a_first_step_that_finds_nothing_costs_no_training(scene, monkeypatch, psi, iterations):
    """From a biased start, the training shows whether objects are found at all; then it is differentiated."""
    monkeypatch.setattr(Trained, "unseen", torch.tensor([False, True]))
    unsure = (replace(SHOWN[0], finding="uncertain"),)
    first = Fake(psi.double(), shown=unsure)
    plain, module = (
        checked_loop(scene, iterations, psi=psi.double(), **more) for more in ({}, {"first": first})
    )
    one, other = (learn_psi(loop) for loop in (plain, module))
    assert [r.detector_steps for r in one.records] == [r.detector_steps for r in other.records]
    assert other.records[0].verdicts == {} and other.shown == unsure
    assert torch.equal(one.last, other.last)


@pytest.mark.parametrize("finds", [False, True])
def test_an_object_that_is_neither_read_nor_found_is_guessed_and_then_takes_steps(
    scene, monkeypatch, caplog, finds
):
    caplog.set_level("INFO")
    unread = (replace(SHOWN[0], finding="not told apart"), replace(SHOWN[0], name="b", finding="stays"))
    module = checked_loop(scene, 3, first=Fake(THERE.double(), shown=unread), psi=THERE.double())
    monkeypatch.setattr(Trained, "unseen", torch.tensor([not finds, True]))
    scored_by(monkeypatch, lambda psi: -psi.abs().amax(1))
    learned = learn_psi(module)
    tried = learned.records[0].verdicts
    assert ("found next to none of it, so a training tries a guess" in caplog.text) == (not finds)
    assert [one.guessed for one in learned.shown] == [not finds, False]
    if finds:
        assert not tried and torch.equal(learned.trajectory[0], THERE.double())
    else:
        assert set(tried) == {"a"} and tried["a"].accepted
        assert set(learned.records[0].certificate.actions) == {"a"}
        assert torch.equal(learned.last[1], THERE[1].double()) and float(learned.last[0].abs().max()) < 3.0


@pytest.mark.parametrize("right", [True, False])
def test_an_object_that_was_read_takes_no_step_along_a_derivative_unless_a_training_rejects_it(
    scene, monkeypatch, right
):
    psi = torch.stack([THERE[0], torch.zeros(4)])
    module = checked_loop(scene, first=Fake(psi))
    scored_by(monkeypatch, lambda psi: torch.stack([psi[0, 0] if right else -psi[0, 0], psi[1, 0] * 0.0]))
    learned = learn_psi(module)
    assert learned.records[0].verdicts["a"].accepted == right and len(learned.records) == 3
    _, tried, *_ = learned.trajectory
    assert torch.equal(tried[0], psi[0].double()) == right and bool(tried[1].any())
    certificate, free = learned.records[0].certificate, {"b"} if right else {"a", "b"}
    assert set(certificate.actions) == set(certificate.p_values) == free  # b alone still moves
    # No probes are rendered for the object that is settled, and nothing is differentiated.
    assert [bool(own) for own in module._probes.probes] == [not right, True]
    assert (
        learned.records[0].gradient_norms[0] == 0.0 if right else learned.records[0].gradient_norms[0] > 0.0
    )


@pytest.mark.parametrize("psi", [torch.zeros(2, 4), THERE], ids=["stay", "move"])
def test_a_loop_whose_objects_were_all_read_ends_without_a_derivative(scene, monkeypatch, psi):
    both = (*SHOWN, replace(SHOWN[0], name="b"))
    module = checked_loop(scene, 4, first=Fake(psi, shown=both))
    scored_by(monkeypatch, lambda psi: torch.stack([psi[0, 0], psi[1, 1]]))
    learned = learn_psi(module)
    (record,) = learned.records
    assert torch.equal(learned.last, psi.double()) and record.certificate is None
    # One training at the start, and one to judge what was proposed.
    assert record.images == 7 + 12 * (2 if psi.any() else 1)


def test_a_reading_that_a_training_accepts_is_not_taken_back_for_less_than_trainings_scatter(
    scene, monkeypatch
):
    """The object's score falls by 0.01 where it was read; the other's scatters by 0.5 between trainings."""
    psi = torch.stack([THERE[0], torch.zeros(4)])
    both = (*SHOWN, replace(SHOWN[0], name="b", finding="stays"))
    met = []

    def scores(trained):
        number = next((n for n, one in enumerate(met) if one is trained), len(met))
        met.extend([trained] * (number == len(met)))
        return (
            torch.tensor([-0.01 * bool(trained.psi[0].any()), 0.5 * (number % 2)])[:, None].expand(2, 6) / 6
        )

    monkeypatch.setattr(Trained, "scores", property(lambda trained: scores(trained).double()))
    given = {"first": Fake(psi, shown=both), "steps": TrustRegion()}
    learned = learn_psi(checked_loop(scene, 4, **given))
    assert learned.records[-1].verdicts["a"].accepted and not learned.records[-1].taken_back
    assert torch.equal(learned.last, psi.double())
    monkeypatch.setattr(Way, "settled", lambda way, names: way)  # the best psi on its way is the start
    assert "a" in learn_psi(checked_loop(scene, 4, **given)).records[-1].taken_back


def test_what_was_read_in_part_is_not_read():
    zoom = replace(SHOWN[0], factor="zoom", finding="uncertain")
    assert read_objects(SHOWN) == {"a"} and read_objects((*SHOWN, zoom)) == set()
    assert read_objects((replace(SHOWN[0], finding="stays"),)) == {"a"}
    assert read_objects((replace(SHOWN[0], finding="nearer"),)) == set()


def test_one_iteration_takes_the_first_step_alone(scene, monkeypatch):
    module = checked_loop(scene, 1, first=Fake(THERE))
    scored_by(monkeypatch, lambda psi: torch.stack([psi[0, 0], psi[1, 1]]))
    learned = learn_psi(module)
    assert torch.equal(learned.last, THERE.double()) and learned.records[0].certificate is None


def test_a_first_step_wants_a_training_that_judges_it():
    with pytest.raises(ValueError, match="outer/first_step"):
        Outer(first_step=LabelShift(), steps=FreeSteps())


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
