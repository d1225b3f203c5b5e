"""Command lines in yesterday's words: what is gone is refused in one line, what has moved is translated."""

import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed
from omegaconf import OmegaConf

from neural_sim.configuration import GONE, MOVED, UserError, updated
from neural_sim.main import conf_directory

ROOT = Path(__file__).parents[1]
MOVES = {
    "outer.trust": "outer.adjoint.trust",
    "outer.adjoint": "outer/adjoint",
    "outer.steps=checked": "outer/steps=trust_region",
    "outer.steps=free": "outer/steps=gradient",
}


@pytest.mark.parametrize(
    "word",
    [
        "gradient=old", "solver=cg,old", "solver=choice(old,cg)", "+solver=old", "outer.shape=1",
        "++outer.shape.size=1", "outer.shape", "~outer.shape", "outer.update._target_=package.Old",
    ],
)  # fmt: skip
def test_what_is_gone_is_refused_in_one_line_that_says_what_to_take(word):
    gone = dict.fromkeys(
        ("gradient=old", "solver=old", "outer.shape", "outer.update._target_=package.Old"), "want new"
    )
    with pytest.raises(UserError, match=r"^\S+ is gone: want new$"):
        updated(["seed=1", word], gone, {})


@pytest.mark.parametrize(
    ("word", "today"),
    [
        ("outer.trust.level=0.2", "outer.adjoint.trust.level=0.2"),
        ("++outer.trust.level=0.2", "++outer.adjoint.trust.level=0.2"),
        ("~outer.trust", "~outer.adjoint.trust"),
        ("outer.trust={a: 1, b: [2, 3]}", "outer.adjoint.trust={a: 1, b: [2, 3]}"),
        ("outer.adjoint=implicit,unrolled", "outer/adjoint=implicit,unrolled"),
        ("++outer.adjoint=implicit", "outer/adjoint=implicit"),
        ("outer.steps=checked", "outer/steps=trust_region"),
        ("outer.steps=free,checked", "outer/steps=gradient,trust_region"),
    ],
)
def test_what_has_moved_is_translated_and_said(word, today):
    assert updated(["-m", word], {}, MOVES) == (["-m", today], [f"{word} is now {today}"])


@pytest.mark.parametrize(
    "word",
    [
        "outer.adjoint.rtol=1", "outer.trusted=1", "outer.steps=other", "outer.steps=free,other", "trust.level=1",
        "solver=older", "--config-dir=old", "-m", "+experiment=pose_gap", "name=old",
    ],
)  # fmt: skip
def test_all_other_words_stay(word):
    assert updated([word], {"solver=old": ""}, MOVES) == ([word], [])


def _keys(node, prefix=""):
    for key, value in node.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{key}.")


def _exists(name):
    """Whether a key, or a choice of a group, is one of today's."""
    key, _, choice = name.partition("=")
    if (conf_directory() / key).is_dir():
        return not choice or (conf_directory() / key / f"{choice}.yaml").is_file()
    config = OmegaConf.to_container(composed(), resolve=False)
    return key in set(_keys(config)) and not choice


def test_the_tables_are_true():
    """A key that has become a group is still the node of that group's choice."""
    renamed = [old for old, new in MOVED.items() if "/" not in new]
    assert not [name for name in (*GONE, *renamed) if _exists(name)]
    assert not set(GONE) & set(MOVED)


def test_the_command_line_refuses_what_is_gone():
    command = [sys.executable, "-m", "src.main", "+experiment=pose_gap", "baseline=none"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.strip() == f"neural-sim: baseline=none is gone: {GONE['baseline=none']}"


@pytest.mark.parametrize(
    ("overrides", "size"),
    [
        ((), 96),
        (("objects=photos", "objects.root=x"), 160),
        (("objects=co3d", "objects.root=x"), 160),
        (("objects=photos", "objects.root=x", "views.image_size=128"), 128),
    ],
)
def test_views_of_photographs_are_larger_unless_told(overrides, size):
    assert composed("scale=quick", *overrides).views.image_size == size
