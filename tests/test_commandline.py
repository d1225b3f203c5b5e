"""Slips at the command line: each is one line that says what to type instead, before anything heavy is imported."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from documented import commands

from neural_sim.commandline import FOLDERS, OWN_WORDS, checked, explained, layout_of, present
from neural_sim.configuration import UserError, conf_directory
from neural_sim.guide import VERBS, answer, spoken

ROOT = Path(__file__).parents[1]
LAYOUT = layout_of([], conf_directory())
SLIPS = [  # what is typed, and what the line must say
    ("detecter=fcos", "detecter: unknown key; did you mean detector"),
    ("+detecter=fcos", "detecter: unknown key; did you mean detector"),
    ("sead=1", "did you mean seed?"),
    ("+seeds=0,1", "did you mean seed"),
    ("detector=fco", "did you mean detector=fcos?"),
    ("baseline=neural", "did you mean baseline=neural_sim?"),
    ("+baseline=lts", "want baseline=lts"),
    ("experiment=pose_gap", "want +experiment=pose_gap"),
    ("+experiment=pose_gapp", "did you mean experiment=pose_gap"),
    ("variant=paper", "want +variant=paper"),
    ("pose_gap", "want +experiment=pose_gap"),
    ("objects", "want objects= and one of bop"),
    ("scale=fast", "scale=fast: no such choice; want one of paper, quick, smoke"),
    ("parameter=[pose,zom]", "did you mean parameter=zoom?"),
    ("outer/step=free", "did you mean outer/steps"),
    ("objects/pose=colmap", "did you mean objects/poses"),
    ("solver/damping=lanzcos", "did you mean solver/damping=lanczos?"),
    ("iterations=3", "did you mean outer.iterations"),
    ("photographs of a pot", "want key=value"),
    ("stage=[psi]", "did you mean stages"),
]
BELOW = [  # keys that Hydra refuses once it has composed
    ("outer.iteration", "did you mean outer.iterations?"),
    ("training.epochs", "did you mean"),
    ("synthesis.object_per_image", "did you mean synthesis.objects_per_image?"),
    ("objects.root", "want objects=bop or objects=co3d or objects=folder"),
    ("target.annotations", "want target=coco"),
    ("work_precision.families", "want +experiment=work_precision"),
]


@pytest.mark.parametrize(("typed", "said"), SLIPS)
def test_a_slip_is_one_line_that_says_what_to_type(typed, said):
    with pytest.raises(UserError) as caught:
        checked([typed], LAYOUT)
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("key", "said"), BELOW)
def test_a_key_that_is_not_there_is_explained(key, said):
    assert said in explained(key, LAYOUT)


@pytest.mark.parametrize(
    "typed",
    [
        "outer.iteration=3", "objects.root=/data", "stages=[train]", "objects=photos objects.root=/nowhere",
        "outer.iterations=0", "stages=[export] export.width=640", "stages=[predict]",
    ],
)  # fmt: skip
def test_nothing_of_hydras_reaches_the_user_and_it_takes_no_more_than_three_seconds(typed):
    begun = os.times()
    clock = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "src.main", *typed.split()],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    used = os.times().children_user - begun.children_user
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith("neural-sim: ") and done.stderr.count("\n") == 1
    assert min(used, time.perf_counter() - clock) < 3.0  # of the processor, where others use it too


def test_a_task_may_get_its_path_from_elsewhere():
    for words in (["--cfg", "job"], ["+experiment=mine"], ["--config-dir=mine"], ["predict.images=*.png"]):
        present(["stages=[predict]", *words])


def test_all_documented_commands_are_let_through():
    for command in commands("main"):
        words = spoken(list(command.arguments))
        own = {*OWN_WORDS, *FOLDERS} & {word.partition("=")[0] for word in words}
        checked(words, layout_of(words, conf_directory()) if own else LAYOUT)


def test_folders_and_configurations_of_ones_own(tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text(
        "# @package _global_\nname: mine\nown_task: {_target_: own.Task}\n"
    )
    for words in (["--config-dir", str(tmp_path)], [f"--config-dir={tmp_path}"]):
        layout = layout_of(words, conf_directory())
        checked([*words, "+experiment=mine", "own_task._target_=other.Task"], layout)
        with pytest.raises(UserError, match="did you mean own_task"):
            checked([*words, "+experiment=mine", "own_tusk.a=1"], layout)
    assert layout_of(["--config-name=other"], conf_directory()) is None
    assert layout_of(["-sc", "install=bash"], conf_directory()) is None


LEFT_TO_HYDRA = [
    ["~parameter.pose.biased"],
    ["hydra.job.chdir=true"],
    ["-m", "seed=range(0,3)"],
    ["+baseline@mine=lts"],
    ["objects=photos", "objects/poses=colmap"],
    ["parameter=[]"],
    ["+mine={_target_: my_task.Task}", "stages=[mine]"],
    ["-m", "objects=ycb,procedural"],
    ["--cfg", "job", "seed=1"],
    ["--info", "defaults"],
]


@pytest.mark.parametrize("words", LEFT_TO_HYDRA)
def test_what_hydra_takes_is_left_to_it(words):
    checked(words, LAYOUT)


@pytest.mark.parametrize("verb", VERBS)
def test_commands_stand_for_words_that_exist_and_show_keys_with_their_comments(verb):
    words = spoken([verb, "seed=3"])
    assert words[-1] == "seed=3"
    checked(words, LAYOUT)
    text = answer([verb, "--help"], LAYOUT)
    assert text.startswith(f"neural-sim {verb}: ")
    for key in VERBS[verb].keys:
        assert f"    {key}=" in text


def test_help_shows_commands_experiments_and_choices_on_a_screen():
    text = answer(["--help"], LAYOUT)
    assert len(text.splitlines()) <= 52 and all(f"    {verb} " in text for verb in VERBS)
    assert all(f" {name}" in text for name in LAYOUT.groups["experiment"])
    assert all(f"    {group} " in text for group in LAYOUT.defaults)
    assert "\nouter: # the psi loop" in answer(["--help", "keys"], LAYOUT)
    assert answer(["--version"], LAYOUT).startswith("neural-sim")
    assert answer(["seed=1"], LAYOUT) is None
