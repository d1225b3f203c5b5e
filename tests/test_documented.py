"""Every command that the documentation shows composes and builds; what takes minutes, running them, is in
test_documented_runs.py."""

import argparse
import functools
import re
import runpy
from pathlib import Path

import pytest
from composing import composed
from documented import FLAGS, PAGES, ROOT, commands, commands_in, nox_sessions, spans
from documented_data import MadeData, with_given_cameras
from omegaconf import OmegaConf

from neural_sim import main as program
from neural_sim.report.tracking import tracking_uri
from neural_sim.tasks.walk import PHASES

CONF = program.conf_directory()
FILES = ("json", "md", "html", "png", "py", "yaml", "db", "pt", "safetensors")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return MadeData(tmp_path_factory.mktemp("data"))


@functools.cache
def compose_and_build(overrides):
    """All parts of what a command would run, from a configuration; refused as the command line refuses."""
    config = composed(*overrides)
    context, _ = program.context_of(config, Path("unused"))
    if set(context.stages) & set(PHASES) and config.trainer.accelerator == "cpu":
        assert context.graph.names


@pytest.mark.parametrize("command", commands("main"), ids=lambda command: command.where)
def test_a_documented_run_composes_and_builds(command, data):
    """All jobs of a sweep with its first seed, and one with its last."""
    assert command.flags <= FLAGS
    for job in [*command.jobs(seeds=1), command.jobs()[-1]]:
        compose_and_build(
            (*(data.localise(word) for word in with_given_cameras(job)), f"paths.data={data.shared}")
        )


class _Parsed(Exception):
    """Carries a script's parser out of it before it does anything."""


@pytest.mark.parametrize("command", commands("benchmark"), ids=lambda command: command.where)
def test_a_documented_benchmark_knows_its_options(command, data, monkeypatch):
    def carry_out(parser, *_):
        raise _Parsed(parser)

    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    with monkeypatch.context() as patched, pytest.raises(_Parsed) as caught:
        patched.setattr(argparse.ArgumentParser, "parse_args", carry_out)
        runpy.run_path(str(ROOT / command.words[1]), run_name="__main__")
    (parser,) = caught.value.args
    parsed = parser.parse_args(
        [data.localise(word) for word in command.arguments]
    )  # exits where it knows no option
    compose_and_build(tuple(getattr(parsed, "overrides", ())))


def test_documented_nox_sessions_exist():
    for command in commands("nox"):
        assert command.arguments[:1] in ((), ("-s",)), command
        assert set(command.arguments[1:]) <= nox_sessions(), command


def test_the_documented_mlflow_uri_leads_to_the_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    default = tracking_uri(OmegaConf.load(CONF / "config.yaml").paths.mlflow)
    uris = [command.arguments[command.arguments.index("--backend-store-uri") + 1]
            for command in commands("mlflow") if command.arguments]  # fmt: skip
    assert uris and all(tracking_uri(uri.removeprefix("sqlite:///")) == default for uri in uris)


def _keys(node, prefix):
    for key, value in node.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _keys(value, f"{prefix}{key}.")


def _known_keys():
    """Every key of every file of conf/, at the place in the configuration that the file's package says."""
    for path in CONF.rglob("*.yaml"):
        package = re.match(r"# @package (\S+)", path.read_text(encoding="utf-8"))
        place = package[1] if package else ".".join(path.relative_to(CONF).parent.parts)
        prefix = "" if place in ("_global_", "") else f"{place}."
        yield place
        yield from _keys(OmegaConf.to_container(OmegaConf.load(path)), prefix)


def _named_settings():
    """Where, key and value ("" without one) of each word in code that can only be a key of the configuration."""
    for page in PAGES:
        for line, code in spans(page.read_text(encoding="utf-8")):
            for word in code.split():
                found = re.fullmatch(
                    r"([a-z_]+(?:/[a-z_]+)?(?:\.[a-z_0-9]+)*)(?:\.\*|=(.*))?", word.strip("'\",")
                )
                if found and ("." in found[1] or found[2]) and found[1].split(".")[-1] not in FILES:
                    yield f"{page.name}:{line}", found[1], found[2] or ""


def test_settings_named_in_the_text_exist():
    known, groups = (
        set(_known_keys()),
        {str(path.relative_to(CONF)) for path in CONF.rglob("*") if path.is_dir()},
    )
    tops = {key.split(".")[0] for key in known}
    checked, wrong = 0, []
    for where, key, value in _named_settings():
        if key in groups:
            choices = [choice for choice in value.strip("[]").split(",") if choice]
            missing = [choice for choice in choices if not (CONF / key / f"{choice}.yaml").is_file()]
            wrong += [f"{where}: {key}={choice}" for choice in missing]
        elif key.split(".")[0] in tops:
            wrong += [] if key in known else [f"{where}: {key}"]
        else:
            continue
        checked += 1
    assert checked > 40 and not wrong


TEXT = """Text with `nox -s
lint` and `python -m src.main seed=1 'a.b=[1, 2]'` and `seed=3`.

    python -m src.main -m x=1,2 \\
        seed=0,1 'y=[3,4]'   # it's a comment && nox -s nothing
    OMP_NUM_THREADS=1 python benchmarks/outer.py --images -- a=1 && nox -s tests

not code:
    nox -s indented_text

```
mlflow ui --port 1
ls -l
```
    nox -s after_a_fence
"""


def test_commands_are_found_in_text_and_blocks_and_taken_apart_as_a_shell_does():
    found = list(commands_in(TEXT, "page"))
    assert [(command.where, *command.words) for command in found] == [
        ("page:1", "nox", "-s", "lint"),
        ("page:2", "python", "-m", "src.main", "seed=1", "a.b=[1, 2]"),
        ("page:4", "python", "-m", "src.main", "-m", "x=1,2", "seed=0,1", "y=[3,4]"),
        ("page:6", "python", "benchmarks/outer.py", "--images", "--", "a=1"),
        ("page:6", "nox", "-s", "tests"),
        ("page:12", "mlflow", "ui", "--port", "1"),
    ]
    assert [command.kind for command in found] == ["nox", "main", "main", "benchmark", "nox", "mlflow"]
    sweep = found[2]
    assert sweep.jobs() == [[f"x={x}", f"seed={seed}", "y=[3,4]"] for x in (1, 2) for seed in (0, 1)]
    assert sweep.jobs(seeds=1) == [["x=1", "seed=0", "y=[3,4]"], ["x=2", "seed=0", "y=[3,4]"]]
    assert sweep.cut(1) == ["x=1,2", "seed=0", "y=[3,4]"]


def test_a_study_is_taken_apart_as_hydra_does():
    (study,) = commands_in("`python -m src.main +experiment=gap_levels gap=same baseline=ns,lts`", "page")
    assert study.multirun and not study.flags
    cases = ["pose_gap_ycb", "zoom_gap_ycb", "illumination_gap_ycb"]
    first = [
        [
            "seed=0",
            f"experiment@_global_={case}",
            "gap=same",
            f"baseline={baseline}",
            "+experiment=gap_levels",
        ]
        for case in cases
        for baseline in ("ns", "lts")
    ]
    assert [job for job in study.jobs() if job[0] == "seed=0"] == first
    assert study.jobs(seeds=1) == first[:1]  # the rest is left to tests/test_experiments.py
    assert len(study.jobs()) == 5 * 6


def test_paths_without_made_data_are_refused(data):
    assert data.localise("seed=1") == "seed=1"
    with pytest.raises(AssertionError, match=r"say in documented_data\.py what /data/unheard_of stands for"):
        data.localise("objects.root=/data/unheard_of")
