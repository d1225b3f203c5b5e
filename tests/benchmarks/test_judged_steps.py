"""What finished loops' steps gained, on made-up runs whose gains are known."""

import json
import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "judged_steps.py"


def run(folder, method="neural_sim", commit="abcdef0"):
    """Two objects: the mug's steps are judged in iterations 1, 2 and, last and without a later training, 3."""

    def verdict(expected, measured, accepted):
        return {"expected_gain": expected, "measured_gain": measured, "error": 0.01, "accepted": accepted}

    verdicts = [
        {},
        {"mug": verdict(0.1, 0.3, True)},
        {"mug": verdict(0.01, 0.02, True), "can": verdict(0.01, -0.2, False)},
        {"mug": verdict(9.0, 9.0, True)},
    ]
    scores = [[0.5, 0.2], [0.5, 0.4], [0.45, 0.43], [0.0, 0.0]]
    iterations = [{"scores": s, "verdicts": v} for s, v in zip(scores, verdicts, strict=True)]
    made = {
        "method": method,
        "commit": commit,
        "biased": ["mug"],
        "psi": {"can": {}, "mug": {}},
        "iterations": iterations,
    }
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(made))


def printed(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["judged_steps.py", *map(str, arguments)])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    return capsys.readouterr().out


def test_a_step_is_measured_by_the_training_after_the_one_that_judged_it(tmp_path, monkeypatch, capsys):
    run(tmp_path / "a" / "1")
    run(tmp_path / "a" / "2", commit="0123456")
    run(tmp_path / "b", method="lts")
    rows = printed(monkeypatch, capsys, tmp_path).splitlines()
    assert rows[0] == "2 runs"
    assert {row.split(" | ")[0]: row.split(" | ")[1:] for row in rows[4:]} == {
        "| first, accepted": ["2", "0.1000 (0.0000)", "0.3000 (0.0000)", "0.2000 (0.0000) |"],
        "| later, accepted": ["2", "0.0100 (0.0000)", "0.0200 (0.0000)", "0.0300 (0.0000) |"],
        "| of these, of biased objects": ["2", "0.0100 (0.0000)", "0.0200 (0.0000)", "0.0300 (0.0000) |"],
        "| rejected": ["2", "0.0100 (0.0000)", "-0.2000 (0.0000)", "-0.0500 (0.0000) |"],
    }
    assert printed(monkeypatch, capsys, tmp_path / "a", "--commit", "0123").startswith("1 run\n")


def test_folders_without_a_loop_are_rejected(tmp_path, monkeypatch, capsys):
    run(tmp_path / "b", method="lts")
    with pytest.raises(SystemExit, match=r"1 results\.json, none of a loop"):
        printed(monkeypatch, capsys, tmp_path)
