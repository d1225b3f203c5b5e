"""The page of experiments from made-up finished runs: measured rows have numbers, others say that there are none."""

import json

import pytest
from composing import composed
from finished_runs import BUDGET, setting
from omegaconf import OmegaConf

from neural_sim.configuration import UserError, conf_directory
from neural_sim.report.runs import LeftOut
from neural_sim.studies.experiments import study as module
from neural_sim.studies.experiments.layouts import LAYOUTS, Paper
from neural_sim.studies.experiments.results import Measured
from neural_sim.studies.experiments.study import Experiments, Row, _to_first_table

TABLE = {
    "title": "Table 1",
    "lines": [1, 2],
    "columns": ["NS", "NSO"],
    "rows": {"mAP": [10, 20], "can": [30, None]},
}
PAPER = {
    "claims": {
        "gains": [{"what": "over LTS", "value": 34, "source": "Sec. 4.2", "line": 845, "quote": "34"}]
    },
    "tables": {"one": TABLE, "two": {**TABLE, "title": "Table 2"}},
}
ROWS = {
    "gaps": {
        "title": "Gaps",
        "experiment": "gap_levels",
        "runs": ["gap"],
        "layout": "gaps",
        "claims": ["gains"],
    },
    "large": {
        "title": "Large",
        "experiment": "ycb_large_scale",
        "runs": ["large"],
        "layout": "objects",
        "table": "one",
    },
    "figure": {"title": "Figure", "experiment": "illumination_interpolation"},
    "own": {"title": "Own", "experiment": "nerf_vs_mesh", "document": "nerf_vs_mesh.md"},
    "planned": {"title": "Planned", "experiment": "no_such_file", "runs": ["gap"], "layout": "gaps"},
}
MEASURED = {
    "gap": [
        setting(gap="same", methods=(("neural_sim", 0.75), ("lts", 0.5))),
        setting(gap="disjoint", methods=(("neural_sim", 0.75), ("lts", 0.5)), commit="1234567"),
    ]
}


@pytest.fixture
def page(monkeypatch, tmp_path):
    def read(self, runs):
        return MEASURED.get(runs[0], []), [LeftOut("lts seed 3", "0123456789", runs[0], "it failed")]

    monkeypatch.setattr(module.Settings, "read", read)
    own = {"nerf_vs_mesh": Measured(["below"], "A table of its own.", ["abc1234"])}
    monkeypatch.setattr(module, "newest_document", lambda uri, name, file, budget: own.get(name))

    def write(**arguments):
        step = Experiments(**{"rows": ROWS, "paper": PAPER, "draws": 5, **arguments})
        return step.write("uri", {"budget": BUDGET, "seed": 0}, tmp_path)

    return write


# At 101 recalls, a class of which 75 % is found has an AP of 76 / 101, one of 25 % 26 / 101, and one of 50 % 51 / 101.


def test_the_page_has_what_was_measured_and_says_what_was_not(page, tmp_path):
    text = page(page=str(tmp_path / "page.md"))
    assert (tmp_path / "experiments.md").read_text() == text
    rows = {line.split(" | ")[0].strip("| "): line for line in text.splitlines() if line.startswith("| ")}
    assert "| `python -m src.main +experiment=gap_levels` | gap, can: NSO 75.2" in rows["Gaps"]
    assert (
        "<br>(commit 1234567, unknown) |" in rows["Gaps"] and "| below<br>(commit abc1234) |" in rows["Own"]
    )
    assert "## own\n\nOwn.\n\nA table of its own.\n" in text
    assert rows["Gaps"].endswith("over LTS 34 (Sec. 4.2, l. 845) |  |")
    assert "| not yet measured | Table 1: below |" in rows["Large"]
    assert "figures in the run's folder" in rows["Figure"] and "Planned" not in text
    assert (
        "84 views of 96 pixels" in text and "## gaps" in text and "\n| gap | can | the target's | 0 |" in text
    )
    assert "\n| can | 30 | N/A |" in text.split("## large")[1], "the paper's table where ours is not measured"
    assert "Table 2" in text.split("without an experiment here")[1]
    assert (tmp_path / "figures" / "gaps_levels.png").stat().st_size > 5000
    data = json.loads((tmp_path / "experiments.json").read_text())
    assert list(data["rows"]) == ["gaps", "large", "figure", "own"] and data["rows"]["large"]["ours"] is None
    assert [run["reason"] for run in data["left_out"]] == ["it failed"] * 2
    assert "it failed" in (tmp_path / "left_out.md").read_text()


def test_the_documentation_s_page_is_short_and_its_json_has_the_tables(page, tmp_path):
    page(page=str(tmp_path / "page.md"))
    text = (tmp_path / "page.md").read_text()
    gaps, large, own = (
        text.split(f"\n## {title}\n")[1].split("\n## ")[0] for title in ("Gaps", "Large", "Own")
    )
    assert "\n    python -m src.main +experiment=gap_levels\n" in gaps
    assert "- **The paper**: over LTS 34 (Sec. 4.2, l. 845)\n" in gaps
    assert "- **Ours, commit 1234567, unknown**:\n    - gap, can: NSO 75.2" in gaps
    assert "- **Ours**: not yet measured\n" in large and "A table of its own." in own
    assert _to_first_table("a\n\nb\n\n| c |\n|---|\n\nd\n\n| e |") == "a\n\nb\n\n| c |\n|---|"
    assert "|" not in gaps and "\n| can | 30 | N/A |" in large
    kept = json.loads((tmp_path / "page.json").read_text())["rows"]["gaps"]
    assert kept["entries"][0]["cells"]["object"] == "can" and kept["costs"].startswith("| cost |")


def test_a_page_sends_readers_elsewhere_and_writes_sources_once(page, tmp_path, monkeypatch):
    """Claims of one line of the paper share their source."""
    gains = [{**PAPER["claims"]["gains"][0], "what": what} for what in ("over LTS", "over NS")]
    own = Measured(["from 0.84 to 0.13"], "A table of its own.", ["abc1234"])
    monkeypatch.setattr(module, "newest_document", lambda *arguments: own)
    rows = {"own": {**ROWS["own"], "claims": ["gains"]}}
    for elsewhere in ("", "on the site."):
        rows["own"]["elsewhere"] = elsewhere
        page(page=str(tmp_path / "page.md"), rows=rows, paper={**PAPER, "claims": {"gains": gains}})
        text = (tmp_path / "page.md").read_text()
        assert "- **The paper**: over LTS 34; over NS 34 (Sec. 4.2, l. 845)\n" in text
        assert ("A table of its own." in text) == (not elsewhere)
        lines = elsewhere or "from 0.84 to 0.13"
        assert f"- **Ours, commit abc1234**: {lines}\n" in text


def test_a_row_without_runs_says_what_data_it_needs_and_one_with_runs_does_not(page):
    rows = {name: {**ROWS[name], "needs": "photographs"} for name in ("gaps", "large")}
    text = page(rows=rows)
    assert "| not yet measured, needs photographs |" in text and text.count("photographs") == 1


def test_some_rows_alone(page):
    text = page(only=["large"])
    assert "| Large |" in text and "| Gaps |" not in text and "Table 2" not in text


def test_a_page_keeps_what_it_said_of_experiments_without_runs_here(page, tmp_path, monkeypatch):
    at = str(tmp_path / "page.md")
    first = page(page=at)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(module.Settings, "read", lambda self, runs: ([], []))
        elsewhere.setattr(module, "newest_document", lambda *arguments: None)
        assert page(page=at) == first == page(page=at, only=["large"])
        assert "not yet measured" in page(only=["gaps"]), "only a page keeps"
        newer = Measured(["newer"], "", ["7654321"])
        elsewhere.setattr(module, "newest_document", lambda *arguments: newer)
        second = page(page=at, only=["own"])
    assert "newer<br>(commit 7654321)" in second and "below" not in second.split("| Own |")[1].splitlines()[0]
    assert [line for line in second.splitlines() if "| Gaps |" in line] == [
        line for line in first.splitlines() if "| Gaps |" in line
    ]
    assert set(json.loads((tmp_path / "page.json").read_text())["rows"]) == {"gaps", "own"}
    smaller = {**BUDGET, "outer": {"iterations": 2}}
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(module.Settings, "read", lambda self, runs: ([], []))
        elsewhere.setattr(module.Settings, "read", lambda self, runs: pytest.fail("runs were read before"))
        step = Experiments(rows=ROWS, paper=PAPER, draws=5, page=at, only=["large"])
        before = (tmp_path / "page.json").read_bytes()
        with pytest.raises(UserError, match=r"experiments\.page: .* another scale"):
            step.write("uri", {"budget": smaller, "seed": 0}, tmp_path)
        assert (tmp_path / "page.json").read_bytes() == before


def test_the_page_of_another_study_is_not_overwritten(page, tmp_path):
    (tmp_path / "numerics.json").write_text('{"field": "a table"}')
    with pytest.raises(UserError, match=r"numerics\.json holds no results of experiments"):
        page(page=str(tmp_path / "numerics.md"))
    assert not (tmp_path / "numerics.md").exists()


def test_a_page_keeps_settings_without_runs_here_beside_those_with(page, tmp_path, monkeypatch):
    at = str(tmp_path / "page.md")
    first = page(page=at).splitlines()
    better = setting(gap="same", methods=(("neural_sim", 1.0),), commit="7654321")
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(module.Settings, "read", lambda self, runs: ([better], []))
        second = page(page=at, only=["gaps"]).splitlines()
    start = "| gap | can | disjoint | 0 |"
    (kept,) = [row for row in second if row.startswith(start)]
    assert kept in first, "no run of this start is here"
    (newer,) = [row for row in second if row.startswith("| gap | can | the target's | 0 |")]
    assert "| 100.0" in newer and newer not in first
    assert newer.split(" | ")[5] == "", "LTS of an older commit does not stand beside it"
    assert any("gap, can: NSO 75.2" in row and "(commit 1234567, 7654321) |" in row for row in second)
    assert any(row.startswith("1 run, commit 7654321.") for row in second)


def test_our_scores_stand_beside_those_of_the_papers_table():
    shown, _ = LAYOUTS["objects"](MEASURED["gap"][1:], Paper(**TABLE))
    assert shown.lines[0].startswith("gap, disjoint, mAP: NSO 75.2")
    head, _, mean, can, mug = shown.text.splitlines()[2:]
    assert head == "|  | NS, ours | LTS, ours | NSO, ours | matched, ours | NS, the paper | NSO, the paper |"
    assert mean.startswith("| mAP | 38.1") and mean.endswith("| 10 | 20 |")
    assert can.startswith("| can | 25.7") and can.endswith("| 30 |  |") and mug.endswith("|  |  |")


def test_seconds_of_an_iteration_and_of_a_field_count_stored_fields():
    (line,) = LAYOUTS["seconds"]([setting(seeds=(0, 1))], None)[0].lines
    # Phases hypergradient_* are within hypergradient: 2 + 3. Two objects' fields took 1 s now and 5 s when stored.
    assert line == "gap, disjoint: an iteration takes 5.0 s, an object's field 3.0 s"


def test_seconds_that_differ_are_a_median_and_a_range():
    measured = setting(seeds=(0, 1))
    for factor, run in enumerate(measured.of_reference, start=1):
        run["seconds"]["field"] *= factor
    (line,) = LAYOUTS["seconds"]([measured], None)[0].lines
    assert line.endswith("an object's field 3.2 (3.0 to 3.5) s")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"only": ["none"]}, r"experiments.only: no row \['none'\], want some of gaps"),
        ({"draws": 1}, "draws: want at least 2, got 1"),
        (
            {"paper": {"claims": {}, "tables": {"one": TABLE}}},
            r"gap_levels: the paper's numbers have no \['gains'\]",
        ),
        ({"paper": {**PAPER, "tables": {"one": {**TABLE, "columns": ["NS"]}}}}, "a number for each of"),
        ({"rows": {"x": {"title": "", "experiment": "x", "runs": ["x"], "layout": "pie"}}}, "layout of gaps"),
        ({"rows": {"x": {"title": "", "experiment": "x", "layout": "gaps"}}}, "want runs and a layout"),
        ({"rows": {"x": {**ROWS["gaps"], "document": "gaps.md"}}}, "or a document"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Experiments(**{"rows": ROWS, "paper": PAPER, **arguments})


def test_rows_name_the_runs_that_their_experiments_leave():
    """A study's runs are named by the experiments that it sweeps, others by their own."""
    rows = composed("+experiment=experiments_table").experiments.rows
    for arguments in OmegaConf.to_container(rows).values():
        row = Row(**arguments)
        if not (row.exists and row.runs):
            continue
        text = (conf_directory() / "experiment" / f"{row.experiment}.yaml").read_text()
        swept = [
            line.split(": ")[1].split(",") for line in text.splitlines() if "  experiment@_global_:" in line
        ]
        assert list(row.runs) == (swept[0] if swept else [row.experiment])


def test_what_is_made_twice_is_equal(page):
    assert page() == page()
