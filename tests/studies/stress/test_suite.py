"""Every family passes at its smaller size; what is broken on purpose fails; what is left can be read."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_dir

import neural_sim.field.quadrature as quadrature
import neural_sim.parameter.bins as binned
from neural_sim.main import UserError, conf_directory, context_of
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.studies.stress import cases, linear, rendering, report, sampling, simplex
from neural_sim.studies.stress.cases import FAMILIES, Check, Scope, Suite, run_case
from neural_sim.studies.stress.report import failures, markdown, table, track, write
from neural_sim.tasks.context import TaskFailure
from neural_sim.tasks.walk import walk

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("family", FAMILIES)
def test_every_case_of_every_family_passes(family):
    results = Suite([family], full=False).run_all(seed=0)
    wrong = [(r.case, r.quantity, r.value, r.tolerance, r.status) for r in failures(results)]
    assert results and not wrong


def test_every_file_of_cases_is_a_family():
    folder = Path(linear.__file__).parent
    files = {path.stem for path in folder.glob("*.py") if "\n@case\n" in path.read_text()}
    assert files == set(FAMILIES)


def _failed(name):
    return [result for result in run_case(name, Scope(full=False)) if not result.passed]


def test_a_solver_that_claims_more_than_it_did_fails(monkeypatch):
    assert not _failed("linear/condition_numbers")

    class Boastful(ConjugateGradient):
        def solve(self, *arguments, **options):
            found = super().solve(*arguments, **options)
            return replace(found, value=found.value * (1 + 1e-5))

    monkeypatch.setitem(linear.SOLVERS, "cg", Boastful())
    failed = _failed("linear/condition_numbers")
    assert {result.quantity.split(",")[0] for result in failed} == {"error: cg"}
    assert all(result.value > result.tolerance and result.status == "CONVERGED" for result in failed)


def test_a_wrong_status_fails_however_small_the_error():
    assert Check("x", 0.0, 1.0, "CONVERGED", ("CONVERGED",)).passed
    assert not Check("x", 0.0, 1.0, "MAX_STEPS", ("CONVERGED",)).passed
    assert not Check("x", math.nan, 1.0).passed and not Check("x", 2.0, 1.0).passed


def test_an_uncapped_derivative_fails(monkeypatch):
    original = binned.circular_mean
    monkeypatch.setattr(binned, "circular_mean", lambda y, centre: original(y, centre, 1e-30))
    assert any("1 / cap" in result.quantity for result in _failed("sampling/opposite_bins"))


def test_a_running_sum_that_loses_digits_fails(monkeypatch):
    assert rendering.composite is quadrature.composite
    monkeypatch.setattr(quadrature, "OPAQUE_DEPTH", math.inf)
    assert any("1e+08" in result.quantity for result in _failed("rendering/mixed_densities"))


def test_a_sloppy_projection_fails(monkeypatch):
    def naive(values):
        positive = values.clamp_min(0.0)
        return positive / positive.sum(-1, keepdim=True)

    monkeypatch.setattr(simplex, "project_simplex", naive)
    assert _failed("simplex/projection")


def test_biased_draws_fail(monkeypatch):
    original = binned.gumbel
    monkeypatch.setattr(binned, "gumbel", lambda *arguments: 0.9 * original(*arguments))
    assert _failed("sampling/gumbel_max")
    assert sampling.binned is binned


def test_a_case_that_raises_or_checks_nothing_has_failed(monkeypatch):
    def raising(scope):
        yield Check("first", 0.0, 1.0)
        raise RuntimeError("lost\nand more")

    monkeypatch.setitem(cases.CASES, "x/raising", raising)
    monkeypatch.setitem(cases.CASES, "x/empty", lambda scope: iter(()))
    results = list(run_case("x/raising", Scope()))
    assert [result.passed for result in results] == [True, False]
    assert results[1].status == "RuntimeError: lost"
    (nothing,) = run_case("x/empty", Scope())
    assert not nothing.passed


def test_tolerances_hold_for_other_seeds():
    light = Suite(["linear", "inner", "simplex"], full=False)
    assert not failures(light.run_all(seed=1))


def test_unknown_families_are_refused():
    with pytest.raises(ValueError, match=r"stress\.families"):
        Suite(["linear", "astrology"])
    with pytest.raises(ValueError, match=r"stress\.families"):
        Suite([])


RESULTS = [
    Check("|x|", 0.5, 1.0, "CONVERGED", ("CONVERGED",), "a/one", 0.25),
    Check("y", math.inf, 1.0, case="a/one", seconds=0.5),
    Check("z", 0.0, 0.0, case="b/two", seconds=1.0),
]


def test_files_hold_every_check(tmp_path):
    path = write(RESULTS, tmp_path / "new")
    assert path.name == "stress.json"
    held = json.loads(path.read_text())
    assert [set(row) for row in held] == [
        {"case", "quantity", "value", "tolerance", "status", "passed", "seconds"}
    ] * 3
    assert held[0]["value"] == 0.5 and held[1]["value"] is None and held[1]["passed"] is False
    text = (tmp_path / "new" / "stress.md").read_text()
    assert text == markdown(RESULTS) and "**failed**" in text and r"\|x\|" in text


def test_the_table_has_a_line_a_case_and_names_what_failed():
    lines = table(RESULTS).splitlines()
    assert lines[1].split()[:3] == ["a/one", "2", "1"] and lines[2].split()[:3] == ["b/two", "1", "0"]
    assert lines[3].startswith("FAILED a/one: y")
    assert lines[4] == "3 checks in 2 cases, 1 failed, 1.8 s"


@pytest.mark.slow  # a new MLflow store takes ten seconds
def test_a_run_is_logged(tmp_path):
    from mlflow import MlflowClient

    write(RESULTS, tmp_path / "run")
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    config = {"name": "stress", "seed": 3, "stress": {"families": ["linear"], "full": True}}
    written = track(RESULTS, config, uri, tmp_path / "run", begun=5.0)
    run = MlflowClient(uri).get_run(written.run_id)
    assert run.info.start_time == 5000 < run.info.end_time
    assert run.data.metrics["checks"] == 3 and run.data.metrics["a/one/failed"] == 1
    assert run.data.params["stress.full"] == "True"


def test_bad_settings_name_their_key(tmp_path):
    for override, message in (
        ("stress.families=[x]", "stress.families"),
        ("+stress.speed=1", "stress.speed"),
    ):
        with initialize_config_dir(str(conf_directory()), version_base="1.3"):
            config = compose("config", ["+experiment=stress", override])
        with pytest.raises(UserError, match=message):
            context_of(config, tmp_path)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        listed = compose("config", ["+experiment=stress"]).stress.families
    assert tuple(listed) == FAMILIES


def test_what_failed_is_counted_and_written(tmp_path, monkeypatch):
    monkeypatch.setattr(simplex, "project_sum", lambda values: values)
    monkeypatch.setattr(report, "track", lambda *arguments: SimpleNamespace(where="not logged"))
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        config = compose("config", ["+experiment=stress", "stress.families=[simplex]", "progress=false"])
    with pytest.raises(TaskFailure) as caught:
        walk(*context_of(config, tmp_path))
    held = json.loads((tmp_path / "stress.json").read_text())
    failed = sum(not row["passed"] for row in held)
    assert failed > 0 and str(caught.value) == f"stress: {failed} checks failed"


@pytest.mark.slow
def test_the_command_line_writes_every_family_and_exits_by_what_failed(tmp_path):
    command = [sys.executable, "-m", "src.main", "+experiment=stress", f"hydra.run.dir={tmp_path}/run"]
    command += [f"paths.mlflow={tmp_path}/mlflow.db", "progress=false"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    held = json.loads((tmp_path / "run" / "stress.json").read_text())
    assert {row["case"].split("/")[0] for row in held} == set(FAMILIES)
    assert all(row["passed"] for row in held)
    assert all(math.isfinite(row["tolerance"]) for row in held)
