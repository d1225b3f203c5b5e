"""The scripts in examples/ run as they stand, with smaller budgets."""

import runpy
import sys
from pathlib import Path

import pytest
from captures import capture
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(monkeypatch, capsys):
    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_a_renderer_of_ones_own_learns(run):
    out = run(
        "own_renderer.py",
        "--iterations",
        "2",
        "--images",
        "12",
        "--epochs",
        "1",
        "--renders",
        "8",
        "--steps",
        "4",
    )
    before, after = (line for line in out.splitlines() if line.startswith("total variation"))
    assert "before: warm 0.84, cold 0.84" in before and "after: warm 0." in after


def test_photographs_become_a_field(run, tmp_path):
    folder = capture(tmp_path, "mug", count=12).folder
    out = run(
        "field_from_photographs.py", str(folder), str(tmp_path / "views.png"), "--size", "48", "--steps", "45"
    )
    score = float(out.split("mug: ")[1].split(" dB")[0])
    assert score > 18.0 and "does not show its object" not in out
    assert Image.open(tmp_path / "views.png").size == (4 * 194 + 2, 2 * 194 + 2)


def test_every_example_is_tested():
    tested = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{path.name}"' in tested for path in EXAMPLES.glob("*.py"))
