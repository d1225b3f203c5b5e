"""Measured rows: what is written is read at the same scale alone; documents come from the newest finished run."""

import json

import pytest

from neural_sim.configuration import UserError
from neural_sim.report import tracking
from neural_sim.report.provenance import commit
from neural_sim.studies.experiments.measured import (
    Entry,
    Measured,
    document_of,
    merged,
    newest_document,
    read_measured,
    table,
    write_measured,
)

BUDGET = {"views": {"count": 84}, "field": {"batches": [1024, 8192], "background": None}}
ROWS = {
    "large": Measured(["mAP of NSO 80.0 (70.0 to 90.0)", "ψ"], "| a |\n|---|", ["abc1234"]),
    "small": Measured([], "", []),
    "gaps": Measured(
        [],
        "Costs.",
        [],
        (
            Entry(("pose", "can", 0), {"object": "can", "NS": "1"}, "pose, can: 1", ["abc1234"]),
            Entry(("pose", "can", 1), {"object": "can", "NS": "2"}, "", ["7654321"]),
        ),
    ),
}


def test_what_is_written_is_read_at_the_same_scale_alone(tmp_path):
    file = document_of(str(tmp_path / "page.md"))
    assert file.name == "page.json" and read_measured(file, BUDGET) == {}
    write_measured(file, BUDGET, ROWS)
    assert read_measured(file, BUDGET) == ROWS
    assert read_measured(file, {**BUDGET, "later": {"count": 12}}) == ROWS  # a key that the runs did not know
    with pytest.raises(UserError, match=r"another scale \(budget\.views\.count was \d+ and is 12 now\)"):
        read_measured(file, {**BUDGET, "views": {**BUDGET["views"], "count": 12}})
    with pytest.raises(
        UserError, match=r"\(budget\.\S+ was .+ and is gone\); want that scale, or another page"
    ):
        read_measured(file, {"views": BUDGET["views"]})
    write_measured(file, {}, ROWS)
    with pytest.raises(UserError, match="another scale \\(it names none\\)"):
        read_measured(file, BUDGET)
    file.write_text("{")
    with pytest.raises(ValueError, match=r"page\.json: not readable as JSON"):
        read_measured(file, BUDGET)


def test_the_cell_names_the_commits():
    assert ROWS["large"].cell == "mAP of NSO 80.0 (70.0 to 90.0)<br>ψ<br>(commit abc1234)"
    assert ROWS["gaps"].cell == "pose, can: 1<br>(commit 7654321, abc1234)"
    assert ROWS["gaps"].below == "| object | NS |\n|---|---|\n| can | 1 |\n| can | 2 |\n\nCosts."
    assert ROWS["large"].below == "| a |\n|---|"


def test_entries_are_kept_unless_newer_ones_take_their_place():
    newer = Measured([], "Newer costs.", [], [Entry(("pose", "can", 1), {"object": "can", "NS": "3"})])
    found = newer.with_kept(ROWS["gaps"], ["pose"])
    assert found.below.endswith("| can | 1 |\n| can | 3 |\n\nNewer costs.")
    assert found.cell.endswith("(commit abc1234)"), "that of the entry that is gone is gone with it"
    assert newer.with_kept(None, ["pose"]).entries == tuple(newer.entries)


def test_rows_of_before_there_were_entries_are_read(tmp_path):
    old = {"budget": BUDGET, "rows": {"large": {"lines": ["a"], "text": "b", "commits": ["c"]}}}
    (tmp_path / "page.json").write_text(json.dumps(old))
    assert read_measured(tmp_path / "page.json", BUDGET) == {"large": Measured(["a"], "b", ["c"])}


@pytest.fixture
def uri(tmp_path):
    return tracking.tracking_uri(str(tmp_path / "mlflow.db"))


def log(uri, folder, name, budget=BUDGET, begun=None, fail=False):
    folder.mkdir()
    (folder / "study.md").write_text(f"{name}\n")
    try:
        with tracking.opened(
            uri, "study", name, {}, tracking.flatten({"budget": budget, "seed": 0}), begun
        ) as run:
            run.log_files(folder)
            if fail:
                raise RuntimeError("stopped")
    except RuntimeError:
        pass


def test_the_newest_finished_run_of_the_scale_is_shown(uri, tmp_path):
    smaller = {**BUDGET, "views": {"count": 12}}
    log(uri, tmp_path / "a", "first", begun=1000.0)
    log(uri, tmp_path / "b", "second", begun=2000.0)
    log(uri, tmp_path / "c", "smaller", smaller, begun=3000.0)
    log(uri, tmp_path / "d", "failed", begun=4000.0, fail=True)
    assert newest_document(uri, "study", "study.md", BUDGET) == Measured(
        ["below"], "second", [commit() or "unknown"]
    )
    assert newest_document(uri, "study", "study.md", smaller).text == "smaller"
    assert newest_document(uri, "study", "study.md", {**BUDGET, "later": 1}).text == "second"


def test_without_runs_there_is_no_document(uri, tmp_path):
    log(uri, tmp_path / "a", "first")
    assert newest_document(uri, "study", "other.md", BUDGET) is None
    assert newest_document(uri, "another", "study.md", BUDGET) is None


def entry(*place, **cells):
    return Entry(place, {"object": str(place[1]), **cells})


OLD = [entry("zoom", "can", 2, NS="1", LTS="2", matched="3"), entry("pose", "drill", 2, NS="4")]


def test_newer_entries_stand_for_those_of_the_same_place_and_others_stay():
    new = [entry("zoom", "can", 2, NS="5"), entry("zoom", "can", 0, NS="6"), entry("pose", "can", 1, NS="7")]
    found = merged(OLD, new, ["pose", "zoom"])
    assert [e.place for e in found] == [
        ("pose", "can", 1),
        ("pose", "drill", 2),
        ("zoom", "can", 0),
        ("zoom", "can", 2),
    ]
    assert found[3] is new[0] and found[1] is OLD[1], "an entry is replaced whole, with its commits"
    assert merged(OLD, [], ["zoom"]) == (OLD[0],), "an experiment that the row does not have any longer"


def test_a_table_has_the_columns_of_all_entries_and_empty_cells():
    assert table([OLD[1], OLD[0], entry("zoom", "mug", 2, more="8")]).splitlines() == [
        "| object | NS | LTS | matched | more |",
        "|---|---|---|---|---|",
        "| drill | 4 |  |  |  |",
        "| can | 1 | 2 | 3 |  |",
        "| mug |  |  |  | 8 |",
    ]
