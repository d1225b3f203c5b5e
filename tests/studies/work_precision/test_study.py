"""The stage: its families and what they need, bad settings, the experiment through the command line."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from composing import composed
from documented_checks import check_of
from omegaconf import OmegaConf

from neural_sim.main import UserError, context_of
from neural_sim.studies.work_precision.hypergradient import Hypergradients
from neural_sim.studies.work_precision.study import COMMAND, FAMILIES, WorkPrecision
from neural_sim.tasks.walk import walk

ROOT = Path(__file__).parents[3]


def study(*overrides):
    return composed("+experiment=work_precision", "progress=false", *overrides)


def test_the_experiment_has_every_family_and_the_stages_that_they_need():
    config = study()
    assert tuple(config.work_precision.families) == FAMILIES
    context, _ = context_of(config, Path("unused"))
    graph = context.graph

    def read(*families):
        return keys(WorkPrecision(families=families).reads(context))

    def keys(stages):
        return {stage.key for stage in stages}

    assert not read("quadrature", "solver")
    later = Hypergradients(places=("start", "end"))
    stages = WorkPrecision(families=("hypergradient",), hypergradient=later).reads(context)
    assert graph.learned.key in keys(stages) and graph.learned.key not in read("hypergradient")
    assert read("field") == keys(graph.views)
    each = [*graph.views, graph.warm_start, graph.targets]
    assert read(*FAMILIES) == keys(each)


def test_the_parts_are_those_of_the_configuration(tmp_path):
    step = context_of(study("scale=smoke"), tmp_path)[1]["work_precision"]
    assert set(step.solver.solvers) == {"cg", "minres", "identity"}
    detector = step.solver.detector(num_classes=2, image_size=32)
    trained = detector.split(detector.init(torch.Generator().manual_seed(0)))[1]
    assert sum(part.numel() for part in trained.values()) < 5000  # whose dense Hessian fits in memory
    assert set(step.fits.recipes) == {"grid", "mlp"} and step.quadrature.default == 64


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["parameter=[pose,zoom]"], "want one parameter with bins"),
        (["training.real.mode=combined", "target.train_per_object=2"], r"work_precision\.estimator: want training"),
        (["baseline=lts"], r"work_precision\.hypergradient: .*, got baseline=lts"),
        (["views.held_out=0"], r"views\.held_out of at least 1"),
    ],
    ids=lambda words: words[0] if isinstance(words, list) else "",
)  # fmt: skip
def test_what_a_family_cannot_measure_is_refused_before_the_first_is_measured(overrides, message):
    context, tasks = context_of(study(*overrides), Path("unused"))
    with pytest.raises(ValueError, match=message):
        list(tasks["work_precision"].reads(context))
    tasks["work_precision"] = WorkPrecision(families=("quadrature",))
    assert not list(tasks["work_precision"].reads(context))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("work_precision.families=[astrology]", r"work_precision\.families\[0\]: want one of quadrature"),
        ("work_precision.families=[solver,solver]", r"work_precision\.families"),
        ("work_precision.repeats=0", r"work_precision\.repeats"),
        ("work_precision.clock=sundial", r"work_precision\.clock"),
        ("work_precision.quadrature.rays=1", r"work_precision\.quadrature"),
        ("+work_precision.speed=1", r"work_precision\.speed"),
    ],
)
def test_bad_settings_name_their_key(override, message, tmp_path):
    with pytest.raises(UserError, match=message):
        context_of(study(override), tmp_path)


def test_one_family_leaves_its_files_and_its_section_of_a_page(tmp_path, context):
    page = tmp_path / "page.md"
    config = study(
        "scale=smoke", "work_precision.families=[quadrature]", f"work_precision.docs={page}",
        "work_precision.quadrature.samples=[8,16,32]", "work_precision.quadrature.rays=8",
        f"paths.mlflow={context.config['paths']['mlflow']}",
    )  # fmt: skip
    walk(*context_of(config, context.folder))
    held = json.loads((context.folder / "work_precision.json").read_text())
    assert {row["name"].split("/")[0] for row in held["series"]} == {"quadrature"}
    assert all(math.isfinite(row["error"]) for row in held["series"])
    assert "## Error against run time: quadrature" in page.read_text()
    assert COMMAND in page.read_text()


def test_a_page_that_cannot_be_written_loses_nothing(tmp_path, context):
    (tmp_path / "page.json").write_text("{")
    config = study(
        "scale=smoke", "work_precision.families=[quadrature]", f"work_precision.docs={tmp_path}/page.md",
        "work_precision.quadrature.samples=[8,16,32]", "work_precision.quadrature.rays=8",
        f"paths.mlflow={context.config['paths']['mlflow']}",
    )  # fmt: skip
    with pytest.raises((ValueError, UserError), match=r"page\.json"):
        walk(*context_of(config, context.folder))
    assert json.loads((context.folder / "work_precision.json").read_text())["series"]


@pytest.mark.slow
def test_the_command_line_measures_every_family(tmp_path):
    command = [
        sys.executable,
        "-m",
        "src.main",
        "+experiment=work_precision",
        "scale=smoke",
        "progress=false",
    ]
    command += [
        f"hydra.run.dir={tmp_path}/run",
        f"paths.mlflow={tmp_path}/mlflow.db",
        f"paths.store={tmp_path}/store",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    config = OmegaConf.to_container(OmegaConf.load(tmp_path / "run" / ".hydra" / "config.yaml"), resolve=True)
    check_of(config)(tmp_path / "run", config)
