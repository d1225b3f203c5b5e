"""The first step that the target's boxes propose: which objects move, on what evidence, by whose renders."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small_loop import CHECKED, small_loop

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.baseline.label_shift.network import Fitting
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.first_step import WhatTheTargetShows, p_value_of, with_guesses
from neural_sim.outer.loop import learn_psi
from neural_sim.outer.steps import Proposal
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
