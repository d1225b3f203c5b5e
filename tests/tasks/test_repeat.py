"""Which detectors are trained again; a run of the stage is in test_documented_runs.py."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from neural_sim.main import UserError, conf_directory, context_of
from neural_sim.tasks.repeat import APART, again, groups


def context(*overrides):
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return context_of(
            compose("config", ["+experiment=pose_gap", "scale=smoke", *overrides]), Path("unused")
        )[0]


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
    assert groups(names, {"mug", "drill"}, [0, 1]) == [
        (["mug"], [1]),
        (["can", "mug"], [0, 1]),
        (["can"], [0]),
    ]
    assert groups(names, {}, [0, 2]) == [(["can", "drill"], [0, 2]), (["can"], [0]), (["drill"], [2])]


def test_one_training_is_refused_before_anything_runs():
    with pytest.raises(UserError, match=r"repeat\.trainings must be at least 2"):
        context("stages=[repeat]", "repeat.trainings=1")
