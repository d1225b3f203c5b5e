"""The first step that the target's boxes propose: which objects move, on what evidence, by whose renders."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest
import torch
from small_loop import CHECKED, checked_loop, scored_by, small_loop, watch

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.baseline.label_shift.network import Fitting
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.first_step import WhatTheTargetShows, p_value_of, read_objects, with_guesses
from neural_sim.outer.inner import Numbers, Trained
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import FreeSteps, Proposal
from neural_sim.outer.trust_region import TrustRegion
from neural_sim.outer.way import Way
from neural_sim.parameter.factor import BinnedFactor, ConfiguredDistributions
from neural_sim.parameter.illumination import Illumination
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.scene import Scene

QUICK = LabelShift(per_bin=8, compositions=2, fitting=Fitting(epochs=8), draws=19, fewest=1, strange=1.0)


def estimate(name, factor, p_value, finding="moves"):
    half = (0.5, 0.5)
    return FactorEstimate(name, factor, 9, half, half, half, half, ((1,), (2,)), p_value, 0.05, 0.9, finding)


def test_several_factors_that_move_pay_for_their_number():
    factors = (
        estimate("a", "pose", 0.01), estimate("a", "zoom", 0.03), estimate("b", "pose", 0.01),
        estimate("b", "zoom", 0.001, "stays"), estimate("c", "pose", 0.001, "fits no render"),
        estimate("d", "pose", 0.8), estimate("d", "zoom", 0.9),
    )  # fmt: skip
    found = [p_value_of(factors, name) for name in "abcde"]
    assert found == pytest.approx([0.02, 0.01, 1.0, 1.0, 1.0])


def test_what_is_neither_read_nor_found_is_spread_over_all_bins_that_are_open():
    closed = ConfiguredDistributions(closed={"c": (4,)})
    factors = (
        BinnedFactor("pose", "phi", 4, 0.0, 1.0, configured=closed),
        BinnedFactor("zoom", "distance", 2, 1.0, 2.0),
    )
    scene = SimpleNamespace(names=tuple("abcd"), distribution=SceneDistribution(factors))
    psi = torch.tensor([[4.0, 0.0, 0.0, 0.0, 2.0, 0.0]]).repeat(4, 1).double()
    psi[2, 3] = -torch.inf
    psi[3, :4] = torch.tensor([0.05, 0.0, 0.0, 0.0])
    shown = (
        estimate("a", "pose", 0.9, "not told apart"), estimate("a", "zoom", 0.9, "stays"),
        estimate("b", "pose", 0.9, "uncertain"), estimate("b", "zoom", 0.01, "moves"),
        estimate("c", "pose", 1.0, "fits no render"), estimate("c", "zoom", 1.0, "too few boxes"),
        estimate("d", "pose", 1.0, "uncertain"), estimate("d", "zoom", 0.9, "stays"),
    )  # fmt: skip
    proposal = Proposal(psi, torch.tensor([1.0, 0.01, 1.0, 1.0]), 7, shown)
    found = with_guesses(proposal, set("abcd"), scene)
    guessed = [(one.name, one.factor) for one in found.shown if one.guessed]
    # b moves along zoom, which may be all that it lacks; d is nearly uniform.
    assert guessed == [("a", "pose"), ("c", "pose"), ("c", "zoom")]
    assert all("so a training tries a guess" in one.sentence for one in found.shown if one.guessed)
    p = scene.distribution.probabilities(found.psi)
    assert p["pose"][0].tolist() == pytest.approx([0.25] * 4)
    assert p["pose"][2].tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0.0])
    assert p["zoom"][2].tolist() == pytest.approx([0.5, 0.5])
    assert torch.equal(found.psi[[1, 3]], psi[[1, 3]]) and torch.equal(found.psi[0, 4:], psi[0, 4:])
    assert found.p_values.tolist() == pytest.approx([0.5, 0.01, 0.5, 1.0])
    assert found.images == 7 and float(psi[0, 0]) == 4.0 and proposal.shown == shown
    assert with_guesses(proposal, {"b"}, scene).shown == shown


def test_a_light_that_is_neither_read_nor_found_is_guessed_because_none_covers_the_others():
    light = Illumination(anchors=3)
    scene = SimpleNamespace(names=("a", "b"), distribution=SceneDistribution((light,)))
    psi = torch.tensor([[1.0, 0.0, 0.0], [0.1, 0.3, 0.6]]).double()
    guess = estimate("a", "illumination", 0.9, "uncertain")
    guess = replace(guess, p=(0.1, 0.3, 0.6), lights=True)
    found = with_guesses(
        Proposal(psi, torch.ones(2), 0, (guess, replace(guess, name="b"))), {"a", "b"}, scene
    )
    assert [one.guessed for one in found.shown] == [True, False]  # b is there already
    torch.testing.assert_close(found.psi, psi[[1, 1]])


def test_the_boxes_of_a_target_are_read_off_the_loop_s_renders(scene, monkeypatch):
    """All images of the target are of one bin of the first object; the loop's pool is all that is rendered."""
    estimator = StratifiedEstimator(probes_per_bin=2)
    first = WhatTheTargetShows(QUICK)
    module = small_loop(scene, estimator, 2, pool_per_bin=8, first=first, **CHECKED)
    peaked = torch.tensor([[0.0, 0.0, 9.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    images = scene.training_set(peaked, 24, torch.Generator().manual_seed(3)).images
    module.inner = replace(module.inner, objective=replace(module.inner.objective, images=images))
    rendered, render = [], Scene.render

    def watched(self, label, draw):
        rendered.append(label)
        return render(self, label, draw)

    monkeypatch.setattr(Scene, "render", watched)
    proposal = first.propose(module.inner.pool, images, module.psi.detach(), torch.Generator().manual_seed(0))
    assert rendered == [] and proposal.images > 0
    assert [one.name for one in proposal.shown] == ["a", "b"]
    p = scene.distribution.probabilities(proposal.psi)["pose"][0]
    before = scene.distribution.probabilities(torch.zeros(2, 4))["pose"][0]
    wanted = scene.distribution.probabilities(peaked)["pose"][0]
    assert float(proposal.p_values[0]) <= 0.05
    assert float((p - wanted).abs().sum()) < 0.7 * float((before - wanted).abs().sum())


def test_a_loop_tries_what_the_boxes_show_and_reports_it(scene):
    first = WhatTheTargetShows(replace(QUICK, level=1.0))
    module = small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), 2, pool_per_bin=8, first=first, **CHECKED
    )
    learned = learn_psi(module)
    assert [one.name for one in learned.shown] == ["a", "b"]
    assert set(learned.records[0].verdicts) == {"a", "b"} and "first_step" in learned.records[0].seconds


def test_a_target_that_looks_like_no_render_is_not_believed_and_the_loop_goes_on_as_without(scene):
    """The target's colours are inverted: a wrong estimate, with certainty, were it not for the test of fit."""
    estimator, common = StratifiedEstimator(probes_per_bin=2), {"pool_per_bin": 8, **CHECKED}
    plain = learn_psi(small_loop(scene, estimator, 2, **common))
    strict = replace(QUICK, compositions=4, level=1.0, strange=LabelShift().strange)
    module = small_loop(scene, estimator, 2, first=WhatTheTargetShows(strict), **common)
    images = module.inner.objective.images
    inverted = replace(images, images=1.0 - images.images)
    module.inner = replace(module.inner, objective=replace(module.inner.objective, images=inverted))
    learned = learn_psi(module)
    assert {one.finding for one in learned.shown} == {"fits no render"}
    assert not learned.records[0].verdicts and learned.records[1].verdicts
    assert torch.equal(learned.last, plain.last)


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
    """The training that shows, from a biased start, whether objects are found at all is the one differentiated."""
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
    assert (learned.records[0].gradient_norms[0] == 0.0) == right


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
