"""The command line as a user meets it: one whole run, and what is refused before any stage."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed
from omegaconf import OmegaConf
from PIL import Image

from neural_sim.main import OwnFolder, UserError, build, conf_directory, context_of

ROOT = Path(__file__).parents[1]
CONF = Path(conf_directory())


def _config(*overrides, hydra=False):
    return composed(*overrides, hydra=hydra)


CAPTURES_ONLY = (
    "pycolmap",
    "neural_sim.field.scene",
    "neural_sim.objects.motion",
    "neural_sim.renderer.pose_refinement",
)


def _run(folder, *arguments, **environment):
    paths = [f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db", f"hydra.run.dir={folder}/run"]
    command = [sys.executable, "-m", "src.main", *arguments, *paths]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=600, env=os.environ | environment
    )


def test_one_run_from_objects_to_a_report(tmp_path, empty_store):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    done = _run(
        tmp_path, "+experiment=pose_gap", "scale=smoke", "progress=false", PYTHONPROFILEIMPORTTIME="1"
    )
    assert done.returncode == 0, done.stderr[-3000:]
    loaded = [
        line.split("|")[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")
    ]
    assert "neural_sim.stages.field" in loaded and not [
        name for name in loaded if name.startswith(CAPTURES_ONLY)
    ], "a run on meshes loads what only captures need"
    assert "its scores mean nothing" in done.stdout
    command, address, compare, _, sentence, page = done.stdout.splitlines()[-6:]
    assert "on synthetic test images" in sentence or "over synthetic test images" in sentence
    assert command.startswith("mlflow ui --backend-store-uri sqlite:///")
    assert re.fullmatch(
        r"http://127\.0\.0\.1:5000/#/experiments/1/runs/\w{32}\?workflowType=machine_learning", address
    )
    assert compare.endswith("python -m src.main +experiment=compare 'compare.experiments=[pose_gap]'")
    assert page == f"did it work? open {tmp_path / 'run' / 'report.html'}"
    assert "AP" in (tmp_path / "run" / "report.html").read_text()
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert {"experiment", "method", "seed", "psi", "ap", "seconds", "peak_memory_mb", "left_out"} <= set(
        results
    )
    assert set(results["ap"]) == {"ns", "learned", "matched"} and 0.0 <= results["validation_ap"] <= 1.0
    assert set(results["psi"]["pitcher"]["pose"]) == {"initial", "learned", "target"}
    for distribution in results["psi"]["pitcher"]["pose"].values():
        assert sum(distribution) == pytest.approx(1.0, abs=1e-6)
    assert results["symmetric_bins"]["drill"]["pose"] == [[b] for b in range(1, 9)]
    begun, ended = results["curve"][0], results["curve"][-1]
    assert [begun[key] for key in ("images", "detector_steps", "cpu_seconds")] == [0, 0, 0.0]
    # The warm start (6 objects, 12 images each, 3 epochs of 3 batches) is charged beside the iterations.
    assert ended["images"] == 6 * 12 + sum(record["images"] for record in results["iterations"])
    assert ended["detector_steps"] == 9 + sum(record["detector_steps"] for record in results["iterations"])
    assert ended["cpu_seconds"] > sum(record["cpu_seconds"] for record in results["iterations"])
    verdicts = [record["verdicts"].get("pitcher", {"accepted": False}) for record in results["iterations"]]
    poses = results["psi"]["pitcher"]["pose"]
    assert (poses["learned"] != poses["initial"]) == any(verdict["accepted"] for verdict in verdicts)
    figures = {path.name for path in (tmp_path / "run" / "figures").glob("*.png")}
    assert figures == {
        "strip.png",
        "bins_pose.png",
        "psi_pose.png",
        "ap.png",
        "training_images.png",
        "detections.png",
    }
    coco = json.loads((tmp_path / "run" / "training_set" / "annotations.json").read_text())
    assert coco["images"] and "phi" in coco["images"][0]["poses"][0]

    words = [
        "stages=[views,field,target_sets,warm_start,psi,evaluate,report,repeat]",
        "repeat.trainings=2",
        "repeat.draws=5",
    ]
    again = _run(tmp_path, "+experiment=pose_gap", "scale=smoke", "progress=false", *words)
    assert again.returncode == 0, again.stderr[-3000:]
    repeated = json.loads((tmp_path / "run" / "results.json").read_text())
    assert repeated["ap"] == results["ap"] and repeated["psi"] == results["psi"]
    assert {"views", "field", "warm_start", "psi", "evaluate"} <= {
        left["stage"] for left in repeated["left_out"]
    }
    _, everything, *each = json.loads((tmp_path / "run" / "repeat.json").read_text())["groups"]
    for which, score in results["ap"].items():
        first, second = zip(*(group["scores"][which] for group in each), strict=True)
        assert first == pytest.approx(list(score["per_class"].values()), abs=1e-6) and second != first
        assert everything["scores"][which][0] == pytest.approx(score["ap"], abs=1e-6)
    assert "After 2 trainings of each distribution" in again.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=abc", "seed: want"),
        ("seed=-1", "seed: want"),
        ("stages=[fields]", "unknown stage 'fields'"),
        ("outer.iterations=many", "outer.iterations"),
        ("outer.iterations=0", "outer.iterations"),
        ("+outer.speed=3", "outer.speed: unknown key"),
        ("outer.trust.on_untrusted=ignore", "outer.trust.on_untrusted"),
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
        context_of(_config("+experiment=pose_gap", "scale=smoke", override), Path())
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_user_error_is_one_line_and_exit_status_two(tmp_path):
    done = _run(tmp_path, "+experiment=pose_gap", "seed=abc")
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("neural-sim: seed: want")
    assert "Traceback" not in done.stderr


def test_a_run_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "run").write_text("a file")
    done = _run(tmp_path, "scale=smoke")
    assert done.returncode == 2 and not done.stdout
    assert done.stderr == (
        f"neural-sim: hydra.run.dir: {tmp_path}/run cannot be made (File exists); name another folder\n"
    )


def test_a_sweeps_folders_have_names_that_file_systems_take(tmp_path):
    """Whatever is overridden: values with slashes, and more of them than a name has room for."""
    one, two = (
        "{initial: {dominant: 1}, target: {dominant: 2}}",
        "{initial: {dominant: 3}, target: {dominant: 4}}",
    )
    biased = f"{{can: {one}, mug: {two}}}"
    done = _run(
        tmp_path, "-m", "scale=smoke", "stages=[views]", "objects.names=[can,mug]", "views.image_size=16",
        "views.count=5", "views.held_out=1", f"+parameter.pose.biased={biased}", f"paths.data={tmp_path / 'data'}",
        "progress=false", f"hydra.sweep.dir={tmp_path / 'sweep'}", "seed=0,1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    folders = sorted(path.name for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert [name[:2] for name in folders] == ["0_", "1_"] and all(len(name) == 150 for name in folders)
    written = (tmp_path / "sweep" / folders[1] / ".hydra" / "overrides.yaml").read_text()
    assert "seed=1" in written and f"paths.data={tmp_path / 'data'}" in written


def test_help_answers_without_heavy_imports():
    code = "import sys, neural_sim.main; print([m for m in ('torch', 'mlflow', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def _leaves(node, prefix=""):
    for key, value in node.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _file(path):
    return dict(_leaves(OmegaConf.to_container(OmegaConf.load(path))))


def _unresolved(*overrides):
    return OmegaConf.to_container(_config(*overrides), resolve=False)


SCALES = sorted(path.stem for path in (CONF / "scale").glob("*.yaml"))


def test_scales_set_the_same_keys_of_the_budget_and_nothing_else():
    smoke, *others = [_unresolved(f"scale={scale}") for scale in ("smoke", *SCALES)]
    budgets = [dict(_leaves(made.pop("budget"))) for made in (smoke, *others)]
    assert all(made == smoke for made in others)
    assert all(set(budget) == set(budgets[0]) for budget in budgets)
    text = "".join(path.read_text() for path in CONF.rglob("*.yaml"))
    assert not [key for key in budgets[0] if f"${{budget.{key}}}" not in text], "read by no file"


def test_experiments_set_no_key_that_a_scale_sets():
    scaled = {key for key, value in _leaves(_unresolved()) if str(value).startswith("${budget.")}
    files = [
        path for path in (CONF / "experiment").glob("*.yaml") if path.stem != "sample_data"
    ]  # of one size
    leaves = [leaf for path in files for leaf in _file(path).items()]
    set_by_experiments = {key for key, value in leaves if not str(value).startswith("${budget.")}
    assert {"views.count", "outer.iterations", "target.val_per_object"} <= scaled
    assert set_by_experiments and not scaled & set_by_experiments


@pytest.mark.parametrize("scale", SCALES)
def test_every_scale_goes_with_labelled_photographs(scale, tmp_path):
    annotations = tmp_path / "val.json"
    box = {"image_id": 1, "category_id": 1, "bbox": [2, 2, 4, 4]}
    document = {"images": [{"id": 1, "file_name": "a.png"}], "categories": [{"id": 1, "name": "mug"}]}
    annotations.write_text(json.dumps({**document, "annotations": [box]}))
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    made = build(_config("target=coco", f"target.annotations={annotations}", f"scale={scale}"))
    assert made.imaging.target.annotations == str(annotations)
    assert made.training.image_size == made.config["budget"]["training"]["image_size"]


@pytest.mark.parametrize("scale", SCALES)
def test_what_a_scale_sets_can_be_overridden_where_it_is_used(scale):
    overrides = {
        "views.count": 30,
        "training.image_size": 72,
        "outer.iterations": 3,
        "target.val_per_object": 10,
    }
    made = build(_config(f"scale={scale}", *(f"{key}={value}" for key, value in overrides.items())))
    assert made.imaging.views.count == 30 and made.training.image_size == 72
    assert made.loop.outer.iterations == 3 and made.imaging.target.val_per_object == 10
    assert made.imaging.views.image_size == made.config["budget"]["views"]["image_size"]


def _choices():
    for group in (
        "objects",
        "field",
        "task",
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
    if choice.startswith("classifier"):
        overrides.insert(0, "task=classification")
    text = (CONF / group / f"{choice}.yaml").read_text()
    config = _config(*overrides)
    if "???" in text:
        with pytest.raises(UserError, match=group):
            build(config)
        return
    build(config)


@pytest.mark.parametrize("mode", ["run", "sweep"])
def test_what_begins_in_the_same_second_has_a_folder_of_its_own(mode, tmp_path):
    def begun(*overrides):
        wanted = str(tmp_path / "runs" / "2026-01-01_00-00-00")
        config = OmegaConf.create({"hydra": {mode: {"dir": wanted}, "overrides": {"hydra": list(overrides)}}})
        OmegaConf.set_readonly(config, True)
        begin = OwnFolder().on_run_start if mode == "run" else OwnFolder().on_multirun_start
        begin(config)
        taken = config.hydra[mode].dir
        if mode == "sweep" and not overrides:  # each job composes its configuration anew, from overrides
            told = config.hydra.overrides.hydra
            assert _config(*told, hydra=True).hydra.sweep.dir == taken
        else:
            assert config.hydra.overrides.hydra == list(overrides)
        return Path(taken).name

    assert [begun(), begun(), begun()] == [f"2026-01-01_00-00-00{end}" for end in ("", "_2", "_3")]
    assert len(list((tmp_path / "runs").iterdir())) == 3
    for own in (f"hydra.{mode}.dir=runs", f"++hydra.{mode}.dir=runs"):  # may be taken again
        assert begun(own) == "2026-01-01_00-00-00"
