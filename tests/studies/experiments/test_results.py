"""Which runs are the settings of an experiment; rows are kept at one scale; documents come from the newest run."""

import json
from pathlib import Path

import numpy as np
import pytest
from composing import composed
from finished_runs import BUDGET, finished, results
from omegaconf import OmegaConf

from neural_sim.configuration import UserError
from neural_sim.report import tracking
from neural_sim.report.comparison import compare
from neural_sim.report.provenance import commit
from neural_sim.report.runs import FinishedRun, Group, Runs
from neural_sim.report.score_table import average_precision
from neural_sim.studies.experiments.results import (
    MEAN,
    Entry,
    Measured,
    Setting,
    Settings,
    document_of,
    merged,
    modes,
    newest_document,
    read_measured,
    table,
    write_measured,
)


def run(number, method="neural_sim", size=1, budget=BUDGET, **more):
    made = results("gap", method, 0, **more)
    config = {**made["config"], "views": {"size": size}, "budget": budget}
    scoring = f"{made['scoring']} {size}"
    return FinishedRun({**made, "config": config, "scoring": scoring}, f"{method}", f"{number:08d}x", "gap")


def read(*runs):
    return Settings("", BUDGET, "neural_sim", 5, 0).groups(Runs(runs))


def test_starts_and_targets_are_settings_of_one_way_of_scoring():
    groups, left_out = read(run(3), run(2, gap="uniform"), run(1, target=2), run(0, "lts"))
    found = {(group.runs[0].results["gap"], group.runs[0].results["scoring"]) for group in groups}
    assert len(found) == 3 and not left_out
    (disjoint,) = [group for group in groups if len(group.runs) == 2]
    assert [each.method for each in disjoint.runs] == ["neural_sim", "lts"]


def test_runs_of_another_scale_and_of_an_older_way_of_scoring_are_left_out():
    small = {**BUDGET, "outer": {"iterations": 2}}
    groups, left_out = read(run(9, budget=small), run(3), run(2, gap="uniform", size=7))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"]
    reasons = {left.run_id: left.reason for left in left_out}
    assert reasons == {
        "00000009x": "it was run at another scale",
        "00000002x": "newer runs of the experiment are scored in another way",
    }


def test_a_run_from_before_a_key_of_budget_is_of_this_scale():
    before = dict(list(BUDGET.items())[1:])
    groups, left_out = read(run(3, budget=before))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"] and not left_out
    assert not read(run(3, budget={**BUDGET, "gone": 1}))[0] and not read(run(3, budget={}))[0]


def test_distributions_in_short():
    assert modes([0.125] * 8) == "uniform"
    assert modes([0.86, *[0.02] * 7]) == "1"
    assert modes([0.02, *[0.14] * 7]) == "2, 3, 4, 5, 6, 7, 8"
    assert modes([0.44, 0.02, 0.02, 0.02, 0.02, 0.44, 0.02, 0.02]) == "1, 6"


CURVE = [
    {"images": n, "detector_steps": n, "products": 0, "seconds": float(n), "cpu_seconds": float(n),
     "ap": {"per_class": {"can": 0.1, "mug": 0.1}}}
    for n in (0, 1, 2)
]  # fmt: skip


def scored(*methods, draws, seeds=(0, 1), known=("ns", "learned", "matched")):
    runs = []
    for method, ap in methods:
        for seed in seeds:
            each = {"ns": (0.2, 0.4), "learned": (ap, ap + 0.1 * seed), "matched": (0.8, 0.9)}
            rows = {which: each[which] for which in known}
            runs.append(finished(rows, experiment="gap", method=method, seed=seed, curve=CURVE))
    return Setting.of(Group("gap", "gap", "", tuple(runs)), "neural_sim", draws)


def ends(estimate):
    return estimate.value, estimate.low, estimate.high


def test_scores_do_not_need_a_known_target():
    methods = ("neural_sim", 0.7), ("lts", 0.3)
    bare, made = scored(*methods, draws=10, known=("ns", "learned")), scored(*methods, draws=10)
    assert bare.methods == ["ns", "lts", "neural_sim"] == made.methods[:-1]
    for name in ("can", "mug", MEAN):
        assert bare.ahead("lts", name) == made.ahead("lts", name)


def test_objects_have_their_own_ap_and_their_mean_is_that_of_the_comparison():
    made = scored(("neural_sim", 0.7), ("lts", 0.3), ("auto_sim", 0.5), draws=40)
    assert made.methods == ["ns", "lts", "auto_sim", "neural_sim", "matched"]
    assert made.objects == ("can", "mug") and made.seeds == "0, 1"
    for place, name in enumerate(made.objects):
        each = [
            average_precision(run.outcomes["learned"][place])
            for run in made.group.runs
            if run.method == "lts"
        ]
        found = made.score("lts", name)
        assert (
            found.value == pytest.approx(np.mean(each), abs=1e-12) and found.low <= found.value <= found.high
        )
    assert made.score("ns", "can").value == pytest.approx(0.2, abs=0.01)
    compared = compare(made.group.runs, "neural_sim", draws=40)
    for method in ("ns", "lts", "auto_sim", "neural_sim", "matched"):
        assert ends(made.score(method)) == pytest.approx(ends(compared.ap[method]), abs=1e-12)
    for method in ("lts", "auto_sim"):
        assert ends(made.ahead(method)) == pytest.approx(ends(compared.ahead[method]), abs=1e-12)


def test_a_method_is_ahead_of_itself_by_nothing_in_every_draw():
    """Differences are paired: equal detections differ in no resampled set, though their AP does."""
    made = scored(("neural_sim", 0.5), ("lts", 0.5), draws=30)
    for name in (*made.objects, MEAN):
        assert ends(made.ahead("lts", name)) == (0.0, 0.0, 0.0)
        assert made.score("lts", name).low < made.score("lts", name).high


SCALE = {"views": {"count": 84}, "field": {"batches": [1024, 8192], "background": None}}
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


def test_the_page_of_the_documentation_is_at_todays_scale():
    """Otherwise no further experiment could be added to it."""
    budget = OmegaConf.to_container(composed("scale=quick").budget)
    assert read_measured(Path(__file__).parents[3] / "docs" / "experiments.json", budget)


def test_what_is_written_is_read_at_the_same_scale_alone(tmp_path):
    file = document_of(str(tmp_path / "page.md"))
    assert file.name == "page.json" and read_measured(file, SCALE) == {}
    write_measured(file, SCALE, ROWS)
    assert read_measured(file, SCALE) == ROWS
    assert read_measured(file, {**SCALE, "later": {"count": 12}}) == ROWS  # a key that the runs did not know
    with pytest.raises(UserError, match=r"another scale \(budget\.views\.count was \d+ and is 12 now\)"):
        read_measured(file, {**SCALE, "views": {**SCALE["views"], "count": 12}})
    with pytest.raises(
        UserError, match=r"\(budget\.\S+ was .+ and is gone\); want that scale, or another page"
    ):
        read_measured(file, {"views": SCALE["views"]})
    write_measured(file, {**SCALE, "work_precision": {"gone": 64}}, ROWS)  # a key that no run reads
    assert read_measured(file, SCALE) == ROWS
    write_measured(file, {}, ROWS)
    with pytest.raises(UserError, match="another scale \\(it names none\\)"):
        read_measured(file, SCALE)
    file.write_text("{")
    with pytest.raises(ValueError, match=r"page\.json: not readable as JSON"):
        read_measured(file, SCALE)


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
    old = {"budget": SCALE, "rows": {"large": {"lines": ["a"], "text": "b", "commits": ["c"]}}}
    (tmp_path / "page.json").write_text(json.dumps(old))
    assert read_measured(tmp_path / "page.json", SCALE) == {"large": Measured(["a"], "b", ["c"])}


@pytest.fixture
def uri(tmp_path):
    return tracking.tracking_uri(str(tmp_path / "mlflow.db"))


def log(uri, folder, name, budget=SCALE, begun=None, fail=False):
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
    smaller = {**SCALE, "views": {"count": 12}}
    log(uri, tmp_path / "a", "first", begun=1000.0)
    log(uri, tmp_path / "b", "second", begun=2000.0)
    log(uri, tmp_path / "c", "smaller", smaller, begun=3000.0)
    log(uri, tmp_path / "d", "failed", begun=4000.0, fail=True)
    assert newest_document(uri, "study", "study.md", SCALE) == Measured(
        ["below"], "second", [commit() or "unknown"]
    )
    assert newest_document(uri, "study", "study.md", smaller).text == "smaller"
    assert newest_document(uri, "study", "study.md", {**SCALE, "later": 1}).text == "second"


def test_without_runs_there_is_no_document(uri, tmp_path):
    log(uri, tmp_path / "a", "first")
    assert newest_document(uri, "study", "other.md", SCALE) is None
    assert newest_document(uri, "another", "study.md", SCALE) is None


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
