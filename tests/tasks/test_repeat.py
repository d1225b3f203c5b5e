"""Which detectors are trained again, and what their scores say; a run of the task is in test_documented_runs.py."""

from pathlib import Path

import numpy as np
import pytest
from composing import composed
from finished_runs import IMAGES, matches
from scipy.stats import t as student

from neural_sim.main import UserError, context_of
from neural_sim.report.page.verdict import Gain
from neural_sim.report.score_table import THRESHOLDS, Matches, ScoreTable
from neural_sim.tasks.repeat import APART, again, groups, sentence, table


def context(*overrides):
    return context_of(composed("+experiment=pose_gap", "scale=smoke", *overrides), Path("unused"))[0]


def test_the_first_training_is_the_runs_own_and_others_differ_in_their_seed_alone():
    graph = context("seed=3").graph
    own = graph.scores(graph.psi("initial"), "ns")
    first, second = again(own, 0), again(own, 1)
    assert first == own and first.key == own.key != second.key
    assert second.trained.seed == 3 + APART and second.targets is own.targets
    assert second.trained.scene is own.trained.scene and second.trained.psi is own.trained.psi


def test_a_fine_tuned_detector_is_also_pretrained_again():
    graph = context("target.train_per_object=4", "training.real.mode=pretrain").graph
    own = graph.scores(graph.psi("initial"), "ns")
    second = again(own, 1).trained
    assert second.seed == second.start.seed == own.trained.seed + APART
    assert second.key != own.trained.key and second.start.key != own.trained.start.key


def test_the_biased_objects_come_first_then_all_and_each():
    names = ["can", "mug", "drill"]
    assert groups(names, {"mug", "drill"}, ["can", "mug"]) == [["mug"], ["can", "mug"], ["can"]]
    assert groups(names, {}, ["can", "drill"]) == [["can", "drill"], ["can"], ["drill"]]


def test_one_training_is_refused_before_anything_runs():
    with pytest.raises(UserError, match=r"repeat\.trainings: want at least 2, got 1"):
        context("stages=[repeat]", "repeat.trainings=1")


NONE = Matches(
    np.zeros(0, dtype=int), np.zeros((0, len(THRESHOLDS)), dtype=bool), np.zeros(IMAGES, dtype=int)
)
T2 = student.ppf(0.975, 2)


def overlapping(tenths):
    """Every image has one detection, whose overlap is right at ``tenths`` of the ten thresholds from 0.5: AP is that
    fraction, whichever images are drawn."""
    correct = np.tile(np.arange(len(THRESHOLDS)) < tenths, (IMAGES, 1))
    return Matches(np.arange(IMAGES), correct, np.ones(IMAGES, dtype=int))


def of(classes=("mug",), **trainings):
    """By distribution, from each training's matches of the first class; the second has no box."""
    outcomes = {w: [[m, NONE] for m in each] for w, each in trainings.items()}
    return ScoreTable.of(outcomes, ("mug", "can"), draws=400).of_classes(classes)


def half(estimate):
    return (estimate.high - estimate.low) / 2


def test_the_mean_of_trainings_has_students_interval_where_images_do_not_matter():
    found = of(ns=map(overlapping, (4, 5, 6)), learned=map(overlapping, (6, 8, 7)))
    assert found.sample("ns")[0] == pytest.approx([0.4, 0.5, 0.6], abs=0.005)
    assert found.mean("learned").value == pytest.approx(0.7, abs=0.005)
    assert half(found.mean("ns")) == pytest.approx(T2 * 0.1 / 3**0.5, rel=0.02)
    scatter = found.scatter()
    assert scatter.seeds == pytest.approx(0.1, rel=0.02) and scatter.images == pytest.approx(0.0, abs=1e-9)
    # Training by training: 0.2, 0.3, 0.1.
    assert found.ahead("learned", "ns").value == pytest.approx(0.2, abs=0.005)
    assert half(found.ahead("learned", "ns")) == pytest.approx(T2 * 0.1 / 3**0.5, rel=0.02)
    assert not found.ahead("learned", "ns").certain and "No difference can be seen" in sentence(found, "AP")


def test_what_all_trainings_gain_is_certain_however_they_scatter():
    found = of(ns=map(overlapping, (2, 5, 8)), learned=map(overlapping, (4, 7, 10)))
    assert found.ahead("learned", "ns").certain and half(found.ahead("learned", "ns")) < 0.01
    assert (found.mean("learned").low, found.mean("learned").high) == (0.0, 1.0)  # any score
    assert sentence(found, "AP").startswith("After 3 trainings of each distribution: It worked")


def test_the_scatter_over_images_does_not_shrink_with_the_number_of_trainings():
    few, many = (of(ns=[matches(0.5)] * n, learned=[matches(0.75)] * n) for n in (2, 6))
    binomial = (0.5 * 0.5 / IMAGES) ** 0.5
    for found in (few, many):
        assert half(found.mean("ns")) == pytest.approx(1.96 * binomial, rel=0.15)
        assert found.scatter().seeds < 1e-12 and found.scatter().images == pytest.approx(binomial, rel=0.15)
        # A quarter of the images tells them apart.
        assert half(found.ahead("learned", "ns")) == pytest.approx(
            1.96 * (0.25 * 0.75 / IMAGES) ** 0.5, rel=0.15
        )


def test_both_parts_add_as_squares():
    found = of(ns=map(matches, (0.4, 0.5, 0.6)), learned=[matches(0.5)] * 3)
    images = half(found.mean("learned"))
    assert half(found.mean("ns")) == pytest.approx((images**2 + (T2 * 0.1) ** 2 / 3) ** 0.5, rel=0.1)


def test_a_class_without_boxes_is_in_no_mean_and_the_target_sets_the_room():
    which = {"ns": 4, "learned": 6, "matched": 8}
    alone, both = (
        of(classes, **{w: [overlapping(tenths)] * 2 for w, tenths in which.items()})
        for classes in (["mug"], ["mug", "can"])
    )
    assert all(both.mean(w) == alone.mean(w) and both.ahead(w, "ns") == alone.ahead(w, "ns") for w in which)
    assert Gain.of(alone).closed == pytest.approx(0.5, abs=0.01) and both.shown == ["mug"]
    rows = table([alone, both], "AP").splitlines()
    assert [row.split(" | ")[0] for row in rows[2:4]] == ["| mug", "| mean of mug, can"]
    assert "**20.0** (20.0 to 20.0)" in rows[2] and "means of 2 trainings" in rows[-1]
