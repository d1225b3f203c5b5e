"""The command line as a user meets it: one whole run, and what is refused before any stage."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from neural_sim.main import UserError, build, conf_directory

ROOT = Path(__file__).parents[1]
CONF = Path(conf_directory())


def _config(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", list(overrides))


def _run(folder, *arguments):
    paths = [f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db", f"hydra.run.dir={folder}/run"]
    command = [sys.executable, "-m", "src.main", *arguments, *paths]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)


def test_one_run_from_objects_to_a_report(tmp_path):
    done = _run(tmp_path, "+experiment=pose_gap", "scale=smoke", "progress=false")
    assert done.returncode == 0, done.stderr[-3000:]
    command, address = done.stdout.splitlines()[-2:]
    assert command.startswith("mlflow ui --backend-store-uri sqlite:///")
    assert re.fullmatch(
        r"http://127\.0\.0\.1:5000/#/experiments/1/runs/\w{32}\?workflowType=machine_learning", address
    )
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert {"experiment", "method", "seed", "psi", "ap", "seconds", "peak_memory_mb", "left_out"} <= set(
        results
    )
    assert set(results["ap"]) == {"ns", "learned", "matched"} and 0.0 <= results["validation_ap"] <= 1.0
    assert set(results["psi"]["pitcher"]["pose"]) == {"initial", "learned", "target"}
    for distribution in results["psi"]["pitcher"]["pose"].values():
        assert sum(distribution) == pytest.approx(1.0, abs=1e-6)
    assert results["symmetric_bins"]["drill"]["pose"] == [[b] for b in range(1, 9)]
    assert results["psi"]["pitcher"]["pose"]["learned"] != results["psi"]["pitcher"]["pose"]["initial"]
    figures = {path.name for path in (tmp_path / "run" / "figures").glob("*.png")}
    assert figures == {"psi_pose.png", "ap.png", "training_images.png", "detections.png"}
    coco = json.loads((tmp_path / "run" / "training_set" / "annotations.json").read_text())
    assert coco["images"] and "phi" in coco["images"][0]["pose"]

    again = _run(tmp_path, "+experiment=pose_gap", "scale=smoke", "progress=false")
    assert again.returncode == 0, again.stderr[-3000:]
    repeated = json.loads((tmp_path / "run" / "results.json").read_text())
    assert repeated["ap"] == results["ap"] and repeated["psi"] == results["psi"]
    assert {"views", "field", "warm_start", "psi", "evaluate"} <= {
        left["stage"] for left in repeated["left_out"]
    }


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=abc", "seed must be"),
        ("seed=-1", "seed must be"),
        ("stages=[fields]", "unknown stage 'fields'"),
        ("outer.iterations=many", "outer.iterations"),
        ("outer.iterations=0", "outer.iterations"),
        ("+outer.speed=3", "outer.speed: unknown key"),
        ("outer.on_untrusted=ignore", "outer.on_untrusted"),
        ("outer.trust.shrink=2", "outer.trust.shrink"),
        ("solver.damping.margin=0", "solver.damping"),
        ("parameter.pose.temperature=0", "parameter.pose.temperature"),
        ("training.batch_size=1.5", "training.batch_size"),
        ("objects=ycb", "objects.root"),
        ("objects.names=[teapot]", "teapot"),
    ],
)
def test_bad_settings_are_refused_in_one_line_that_names_the_key(override, message):
    with pytest.raises(UserError) as caught:
        build(_config("+experiment=pose_gap", "scale=smoke", override))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_user_error_is_one_line_and_exit_status_two(tmp_path):
    done = _run(tmp_path, "+experiment=pose_gap", "seed=abc")
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("neural-sim: seed must be")
    assert "Traceback" not in done.stderr


def test_help_answers_without_heavy_imports():
    code = "import sys, neural_sim.main; print([m for m in ('torch', 'mlflow', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def _scale_keys(node, prefix=""):
    for key, value in node.items():
        if isinstance(value, dict):
            yield from _scale_keys(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def test_experiments_set_no_key_that_a_scale_sets():
    scales, experiments = set(), set()
    for folder, keys in (("scale", scales), ("experiment", experiments)):
        for path in (CONF / folder).glob("*.yaml"):
            keys |= set(_scale_keys(OmegaConf.to_container(OmegaConf.load(path))))
    assert scales and experiments and not scales & experiments


def _choices():
    for group in (
        "objects",
        "field",
        "detector",
        "solver",
        "solver/damping",
        "gradient",
        "baseline",
        "synthesis",
        "target",
        "scale",
    ):
        for path in sorted((CONF / group).glob("*.yaml")):
            yield group, path.stem


@pytest.mark.parametrize(("group", "choice"), list(_choices()))
def test_every_choice_of_every_group_builds(group, choice, tmp_path):
    overrides = [f"{group}={choice}"]
    text = (CONF / group / f"{choice}.yaml").read_text()
    config = _config(*overrides)
    if "???" in text:
        with pytest.raises(UserError, match=group):
            build(config)
        return
    build(config)
