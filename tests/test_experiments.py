"""Every experiment of conf/experiment: it composes and builds, says what it needs, and stops where that is missing."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed
from documented import Command
from documented_data import MadeData, captures
from omegaconf import OmegaConf

from neural_sim.configuration import conf_directory
from neural_sim.main import UserError, context_of
from neural_sim.tasks.walk import PHASES

ROOT = Path(__file__).parents[1]
CONF = conf_directory()
FILES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((CONF / "experiment").glob("*.yaml"))}
OWN = [name for name, text in FILES.items() if "paths.data" in text]
"""Experiments on data that is not embedded."""
STUDIES = [name for name, text in FILES.items() if "MULTIRUN" in text]


def labels(name, shared):
    """What an experiment wants beside ``paths.data``, where that has no photographs for it."""
    given = {
        "detection_gallery": f"target.annotations={shared / 'ycb_in_the_wild' / 'annotations.json'}",
        "objectnet": f"target.root={shared / 'objectnet'}",
    }
    if name == "photographs":  # made ones are too small for COLMAP
        root = shared / "captures"
        return [f"objects.root={root if root.is_dir() else captures(root)}", "objects/poses=given"]
    return [given[name]] if name in given else []


def made(*overrides):
    return context_of(composed(*overrides), Path("unused"))[0]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Made data in the place of ``paths.data``."""
    return MadeData(tmp_path_factory.mktemp("data")).shared


def _jobs(name):
    return Command(name, ("python", "-m", "src.main", f"+experiment={name}")).jobs()


@pytest.mark.parametrize("name", FILES)
def test_every_experiment_composes_and_builds(name, shared):
    """Scales reach an experiment by ``budget`` alone, see tests/test_main.py."""
    context = made(f"+experiment={name}", f"paths.data={shared}", *labels(name, shared))
    if set(context.stages) & set(PHASES):
        assert set(context.experiment.imaging.distribution.biased) <= set(context.graph.names)


@pytest.mark.parametrize("name", STUDIES)
def test_jobs_of_a_study_are_settings_of_their_own_and_the_last_builds(name, shared):
    """Composed with the method of all studies; the others differ from it by their names."""
    every = [job for job in _jobs(name) if "seed=0" in job]
    jobs, settings = [job for job in every if "baseline=neural_sim" in job], []
    methods = {word for job in every for word in job if word.startswith("baseline=")}
    assert len(every) == len(jobs) * len(methods)
    for job in jobs:
        config = composed(*job)
        parameters = {
            what: OmegaConf.to_container(node, resolve=True) for what, node in config.parameter.items()
        }
        varied = (repr(parameters), repr(config.training.real))
        settings.append((config.name, config.gap, config.baseline.name, *varied))
    assert len(every) > 1 and len(set(settings)) == len(jobs)
    assert made(*every[-1], f"paths.data={shared}").experiment.run.name == settings[-1][0]


@pytest.mark.parametrize("name", [n for n in OWN if n not in (*STUDIES, "photographs")])
def test_experiments_name_objects_that_exist(name, shared_data, shared):
    context = made(f"+experiment={name}", f"objects.root={shared_data / 'ycb'}", *labels(name, shared))
    assert set(context.experiment.imaging.distribution.biased) <= set(context.graph.names)


@pytest.mark.parametrize("name", OWN)
def test_experiments_on_other_data_begin_with_what_they_need_and_how_long_they_take(name):
    comment = [line for line in FILES[name].splitlines() if line.startswith("#")]
    text = " ".join(comment)
    assert re.search(r"the paper's|paper's own bias|pose_bin1_ycb|gap_levels", text, re.IGNORECASE)
    assert "Needs " in text and re.search(r"scale=quick on two cores: about [\d.]+ (minutes|hours)", text)


@pytest.mark.parametrize("name", [n for n in OWN if n not in (*STUDIES, "photographs")])
def test_without_its_data_an_experiment_says_in_one_line_what_to_get_and_where(name, shared, tmp_path):
    with pytest.raises(UserError) as caught:
        made(f"+experiment={name}", f"paths.data={tmp_path}", *labels(name, shared))
    text = str(caught.value)
    assert "\n" not in text and "YCB" in text and str(tmp_path) in text and "objects.root" in text


def test_without_photographs_the_line_names_the_file_and_its_key(shared, tmp_path):
    missing = f"target.annotations={tmp_path / 'annotations.json'}"
    with pytest.raises(
        UserError, match=rf"target.annotations: no such file: {tmp_path}.*; put a COCO file"
    ) as caught:
        made("+experiment=ycb_in_the_wild", f"paths.data={shared}", missing)
    assert "\n" not in str(caught.value)


def test_without_photographs_of_objects_the_line_names_the_folder(tmp_path):
    with pytest.raises(UserError, match=rf"objects.root: {tmp_path}/captures is not a folder") as caught:
        made("+experiment=photographs", f"paths.data={tmp_path}")
    assert "\n" not in str(caught.value)


def test_without_photographs_by_class_the_line_names_the_folder_and_its_key(shared, tmp_path):
    with pytest.raises(
        UserError, match=rf"no such folder: {tmp_path}.*; put photographs there, a folder"
    ) as caught:
        made("+experiment=objectnet", f"paths.data={shared}", f"target.root={tmp_path / 'photos'}")
    assert "\n" not in str(caught.value) and "target.root" in str(caught.value)


@pytest.mark.slow
def test_the_classification_of_photographs_runs_and_its_results_go_on_the_page(shared, tmp_path):
    store = [f"paths.store={tmp_path / 'store'}", f"paths.mlflow={tmp_path / 'mlflow.db'}", "scale=smoke"]
    _run(
        "+experiment=objectnet",
        *store,
        f"paths.data={shared}",
        f"hydra.run.dir={tmp_path / 'run'}",
        "progress=false",
    )
    _run("+experiment=experiments_table", "experiments.only=[objectnet]", "experiments.draws=5", *store,
         f"hydra.run.dir={tmp_path / 'page'}")  # fmt: skip
    (row,) = json.loads((tmp_path / "page" / "experiments.json").read_text())["rows"].values()
    assert "mean accuracy of NSO" in row["ours"][0]
    assert "| mean accuracy |" in (tmp_path / "page" / "experiments.md").read_text()


@pytest.mark.parametrize(
    "name", ["gap_levels", *(pytest.param(n, marks=pytest.mark.slow) for n in STUDIES if n != "gap_levels")]
)
def test_without_its_data_a_study_stops_before_its_first_job(name, tmp_path):
    command = [sys.executable, "-m", "src.main", f"+experiment={name}", f"paths.data={tmp_path}",
               f"hydra.sweep.dir={tmp_path / 'sweep'}"]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2 and not (tmp_path / "sweep").exists()
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("neural-sim: ") and str(tmp_path) in line


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_a_study_runs_and_its_results_go_on_the_page(name, shared, tmp_path):
    """At smoke scale on made data, its first seed and methods, and its first two cases."""
    store = [f"paths.store={tmp_path / 'store'}", f"paths.mlflow={tmp_path / 'mlflow.db'}", "scale=smoke"]
    few = ["baseline=neural_sim,lts"]
    cut = {
        "interpretability": ["gap=uniform"],
        "ycb_large_scale": ["progress=false"],
        "ycb_video_few_shot": ["training.real={mode: pretrain, count: 0},{mode: combined, count: 10}", *few],
        "ycb_video_limited": ["training.real={mode: pretrain, fraction: 0.1}", *few],
        "ycb_in_the_wild": ["gap=disjoint", "wild={target: {dominant: 2}, start: {dominant: 7}}"],
    }.get(name, ["gap=disjoint"])
    _run("+experiment=" + name, "seed=0", *cut, *store, f"paths.data={shared}",
         f"hydra.sweep.dir={tmp_path / 'sweep'}", "progress=false")  # fmt: skip
    folder = tmp_path / "page"
    _run("+experiment=experiments_table", f"experiments.only=[{name}]", "experiments.draws=5", *store,
         f"hydra.run.dir={folder}")  # fmt: skip
    (row,) = json.loads((folder / "experiments.json").read_text())["rows"].values()
    assert row["ours"] and "not yet measured" not in (folder / "experiments.md").read_text()
    tables = ("ycb_large_scale", "ycb_video_few_shot", "ycb_video_limited")
    assert name in tables or list((folder / "figures").glob(f"{name}_*.png"))


def _run(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "src.main", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=3000
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
