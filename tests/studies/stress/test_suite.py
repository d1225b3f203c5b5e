"""Every family passes at its smaller size; what fails is told, written and ends the command with status 1."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from composing import composed

from neural_sim.main import UserError, context_of
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.studies.stress import linear, sampling
from neural_sim.studies.stress.cases import CASES, Check, Scope
from neural_sim.studies.stress.suite import FAMILIES, Stress, failures, markdown, metrics, run_case, table
from neural_sim.tasks.context import TaskFailure
from neural_sim.tasks.walk import walk

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("family", FAMILIES)
def test_every_case_of_every_family_passes(family):
    results = Stress([family], full=False).run_all(seed=0)
    wrong = [(r.case, r.quantity, r.value, r.tolerance, r.status) for r in failures(results)]
    assert results and not wrong


def test_every_file_of_cases_is_a_family():
    folder = Path(linear.__file__).parent
    files = {path.stem for path in folder.glob("*.py") if "\n@case\n" in path.read_text()}
    assert files == set(FAMILIES)


def test_a_solver_that_claims_more_than_it_did_fails(monkeypatch):
    class Boastful(ConjugateGradient):
        def solve(self, *arguments, **options):
            found = super().solve(*arguments, **options)
            return replace(found, value=found.value * (1 + 1e-5))

    monkeypatch.setitem(linear.SOLVERS, "cg", Boastful())
    failed = failures(list(run_case("linear/condition_numbers", Scope(full=False))))
    assert {result.quantity.split(",")[0] for result in failed} == {"error: cg"}
    assert all(result.value > result.tolerance and result.status == "CONVERGED" for result in failed)


def test_a_wrong_status_fails_however_small_the_error():
    assert Check("x", 0.0, 1.0, "CONVERGED", ("CONVERGED",)).passed
    assert not Check("x", 0.0, 1.0, "MAX_STEPS", ("CONVERGED",)).passed
    assert not Check("x", math.nan, 1.0).passed and not Check("x", 2.0, 1.0).passed


def test_a_case_that_raises_or_checks_nothing_has_failed(monkeypatch):
    def raising(scope):
        yield Check("first", 0.0, 1.0)
        raise RuntimeError("lost\nand more")

    monkeypatch.setitem(CASES, "x/raising", raising)
    monkeypatch.setitem(CASES, "x/empty", lambda scope: iter(()))
    results = list(run_case("x/raising", Scope()))
    assert [result.passed for result in results] == [True, False]
    assert results[1].status == "RuntimeError: lost"
    (nothing,) = run_case("x/empty", Scope())
    assert not nothing.passed


def test_tables_and_metrics_name_what_failed():
    results = [
        Check("|x|", 0.5, 1.0, "CONVERGED", ("CONVERGED",), "a/one", 0.25),
        Check("y", math.inf, 1.0, case="a/one", seconds=0.5),
        Check("z", 0.0, 0.0, case="b/two", seconds=1.0),
    ]
    lines = table(results).splitlines()
    assert lines[1].split()[:3] == ["a/one", "2", "1"] and lines[2].split()[:3] == ["b/two", "1", "0"]
    assert lines[3].startswith("FAILED a/one: y")
    assert lines[4] == "3 checks in 2 cases, 1 failed, 1.8 s"
    undefined = [*results, Check("w", math.nan, 1.0, case="a/one")]
    assert metrics(undefined)["a/one/used"] == math.inf and "nan" not in table(undefined).splitlines()[1]
    small = [Check("v", 0.5, 1.0, case="a/one"), Check("w", math.nan, 1.0, case="a/one")]
    assert metrics(small)["a/one/used"] == math.inf, "0.5 would hide what is undefined"
    text = markdown(results)
    assert "**failed**" in text and r"\|x\|" in text
    found = metrics(results)
    assert found["checks"] == 3 and found["failed"] == found["a/one/failed"] == 1


def test_bad_settings_name_their_key(tmp_path):
    for override, message in (
        ("stress.families=[x]", "stress.families"),
        ("stress.families=[]", "stress.families"),
        ("stress.families=[linear,linear]", "stress.families"),
        ("+stress.speed=1", "stress.speed"),
    ):
        config = composed("+experiment=stress", override)
        with pytest.raises(UserError, match=message):
            context_of(config, tmp_path)
    listed = composed("+experiment=stress").stress.families
    assert tuple(listed) == FAMILIES


def test_what_failed_is_counted_written_and_logged(context, monkeypatch):
    monkeypatch.setattr(sampling, "project_sum", lambda values: values)
    config = composed(
        "+experiment=stress",
        "stress.families=[sampling]",
        "progress=false",
        f"paths.mlflow={context.config['paths']['mlflow']}",
    )
    with pytest.raises(TaskFailure) as caught:
        walk(*context_of(config, context.folder))
    held = json.loads((context.folder / "stress.json").read_text())
    keys = {"case", "quantity", "value", "tolerance", "status", "passed", "seconds"}
    assert all(set(row) == keys for row in held)
    failed = sum(not row["passed"] for row in held)
    assert failed > 0 and str(caught.value) == f"stress: {failed} checks failed"
    assert (context.folder / "stress.md").read_text().count("**failed**") == failed


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
