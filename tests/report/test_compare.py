"""A whole comparison of small made-up runs, from MLflow to compare.md and compare.json."""

import json
import shutil

import pytest

from neural_sim.report import logged, tracking
from neural_sim.report.compare import Compare, plain

CONFIG = {
    **{group: {"size": 1} for group in (
        "objects", "views", "field", "renderer", "synthesis", "unlearned", "target", "detector", "training")},
    "parameter": {"pose": {"bins": 8}}, "trainer": {"accelerator": "cpu"},
}  # fmt: skip
BOX = [1.0, 1.0, 8.0, 8.0]


def detections(found, images=8):
    """One mug an image, ``found`` of them detected exactly and nothing else: AP is about that share."""

    def rows(which):
        return [{"image_id": i, "category_id": 1, "bbox": BOX, "score": 1.0 - 0.01 * i} for i in which]

    learned = rows(range(found))
    return {
        "images": images, "truth": rows(range(images)), "ns": rows(range(2)), "learned": learned,
        "matched": rows(range(images)),
    }  # fmt: skip


def results(method, seed, ap, scoring="s", config=(), **changes):
    point = {"images": 10, "detector_steps": 1, "products": 0, "seconds": 5.0, "cpu_seconds": 4.0}
    curve = [
        {key: value * when for key, value in point.items()} | {"ap": {"per_class": {"mug": score}}}
        for when, score in ((0, 0.2), (1, ap))
    ]
    return {
        "experiment": "gap", "gap": "disjoint", "method": method, "seed": seed, "biased": ["mug"], "curve": curve,
        "psi": {"mug": {}}, "total_variation": {"mug": {"pose": {"initial": 0.8, "learned": 1.0 - ap}}},
        "scoring": scoring, "configuration": f"{method} {scoring}", "test_set": f"images of {seed}",
        "iterations": [{"seconds": {"render": 1.0, "train": 2.0}}], "peak_memory_mb": 700.0,
        "config": {**CONFIG, **dict(config)}, "files": {"objects": {"mug": "1" * 64}},
        "code": {"scoring": "a" * 12, "method": "b" * 12}, **changes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def database(empty_store, tmp_path_factory):
    """Two methods on two seeds, a later smoke run of one of them, a run of an older version, and one not evaluated."""
    folder = tmp_path_factory.mktemp("compare")
    uri = tracking.tracking_uri(str(shutil.copy(empty_store, folder / "mlflow.db")))
    old = results("lts", 0, 0.5)
    for key in ("scoring", "configuration", "test_set", "config", "files", "code"):
        del old[key]
    written = [old, results("neural_sim", 0, 0.75), results("neural_sim", 1, 0.75)]
    written += [results("lts", 0, 0.5), results("lts", 1, 0.5)]
    written += [
        results("lts", 0, 0.125, scoring="t", config={"views": {"size": 0}}),
        {"method": "lts", "seed": 5},
    ]
    for number, held in enumerate(written):
        run = folder / str(number)
        run.mkdir()
        (run / "results.json").write_text(json.dumps(held))
        if "curve" in held:
            found = round(8 * held["curve"][-1]["ap"]["per_class"]["mug"])
            (run / "detections.json").write_text(json.dumps(detections(found)))
        tracking.log_run(uri, "gap", f"{held['method']} seed {held['seed']}", {}, {}, {}, {}, run)
    return uri


def test_a_later_smoke_run_changes_no_table_and_is_named(database, tmp_path, capsys):
    (found,) = Compare(("gap",), draws=5).compare(database, 0, {"name": "compare"}, tmp_path)
    assert found.methods == ("neural_sim", "lts") and found.seeds == (0, 1)
    assert found.ap["lts"].value == pytest.approx(0.5, abs=0.01)
    document = json.loads((tmp_path / "compare.json").read_text())
    (table,) = document["comparisons"]
    assert table["scoring"] == "s" and table["heading"] == ""
    assert [(run["method"], run["seed"]) for run in table["runs"]] == [
        ("neural_sim", 0), ("neural_sim", 1), ("lts", 0), ("lts", 1),
    ]  # fmt: skip
    told = {(run["run"], run["reason"].split(",")[0].split(";")[0]) for run in document["left_out"]}
    assert told == {
        ("lts seed 0", "no run of neural_sim is scored in the same way"),
        ("lts seed 0", "an older version wrote it"),
        ("lts seed 5", "it was not evaluated: it left no detections.json"),
    }
    text = (tmp_path / "compare.md").read_text()
    assert "Differences in bold exceed the spread" in text
    assert text.startswith("## gap\n") and "views.size is 0, not 1" in text.split("## Left out")[1]
    assert (
        "Seconds are not comparable" not in text and (tmp_path / "figures" / "gap.png").stat().st_size > 5000
    )
    printed = capsys.readouterr().out
    assert text.strip() in printed and logged.where_runs(database, "gap") in printed
    page = tmp_path / "report.html"
    assert (
        printed.strip().endswith(f"open {page}") and "neural_sim reaches 75.2 AP" in page.read_text()
    )  # 76 of 101 recalls
    (own,) = logged.runs(database, "compare")
    assert own.status == "FINISHED" and {"compare.md", "compare.json", "figures"} <= own.files


def test_classifiers_are_compared_by_accuracy(uri, tmp_path):
    """Four of eight images are right, and six by the reference, whatever the boxes."""
    for method, found in (("neural_sim", 6), ("lts", 4)):
        run = tmp_path / method
        run.mkdir()
        held = results(method, 0, found / 8, score="accuracy")
        (run / "results.json").write_text(json.dumps(held))
        written = detections(found)
        for row in written["learned"]:
            row["bbox"] = [0.0, 0.0, 64.0, 64.0]
        (run / "detections.json").write_text(json.dumps(written))
        tracking.log_run(uri, "gap", method, {}, {}, {}, {}, run)
    (comparison,) = Compare(("gap",), draws=20).compare(uri, 0, {}, tmp_path / "compare")
    assert (comparison.ap["neural_sim"].value, comparison.ap["lts"].value) == (0.75, 0.5)
    ahead = comparison.ahead["lts"]
    assert ahead.value == 0.25 and 0.0 <= ahead.low < 0.25 < ahead.high <= 0.75
    text, page = ((tmp_path / "compare" / name).read_text() for name in ("compare.md", "report.html"))
    assert "**" not in text and "None is in bold: intervals of one seed" in text
    assert "Top-1 accuracy of mug in points" in text and "| method | accuracy |" in text
    assert "neural_sim reaches 75.0 points of accuracy" in page
    assert "AP" not in text and "<th>AP" not in page


def test_two_ways_of_scoring_are_two_tables_whose_headings_say_how_they_differ(database, tmp_path):
    found = Compare(("gap",), reference="lts", draws=5).compare(database, 0, {"name": "compare"}, tmp_path)
    assert [comparison.methods for comparison in found] == [("lts",), ("lts", "neural_sim")]
    text = (tmp_path / "compare.md").read_text()
    assert "## gap, scoring t: views.size=0\n" in text and "## gap, scoring s: views.size=1\n" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "gap_scoring_t.png",
        "gap_scoring_s.png",
    }


def test_no_comparable_run_is_refused_with_the_reasons(database, tmp_path):
    with pytest.raises(
        ValueError, match=r"no evaluated run of compare.reference='ours'.*has no run of this setting"
    ):
        Compare(("gap",), reference="ours", draws=5).compare(database, 0, {}, tmp_path)
    with pytest.raises(ValueError, match="no experiment 'other'"):
        Compare(("other",), draws=5).compare(database, 0, {}, tmp_path)
    with pytest.raises(ValueError, match=r"compare\.methods: no run of typo in gap"):
        Compare(("gap",), draws=5, methods=("typo",)).compare(database, 0, {}, tmp_path)


def test_seconds_of_several_kinds_of_device_are_called_so(uri, tmp_path):
    for method, kind in (("neural_sim", "gpu"), ("lts", "cpu")):
        run = tmp_path / method
        run.mkdir()
        held = results(method, 0, 0.5, config={"trainer": {"accelerator": kind}})
        (run / "results.json").write_text(json.dumps(held))
        (run / "detections.json").write_text(json.dumps(detections(4)))
        tracking.log_run(uri, "gap", method, {}, {}, {}, {}, run)
    Compare(("gap",), draws=5).compare(uri, 0, {}, tmp_path / "compare")
    text = (tmp_path / "compare" / "compare.md").read_text()
    assert "Seconds are not comparable" in text and "cpu: lts seed 0" in text


def test_numbers_that_json_lacks_are_null():
    document = {"a": [float("nan"), (1.0, float("inf"))], "b": {"c": 2, "d": "nan"}}
    assert plain(document) == {"a": [None, [1.0, None]], "b": {"c": 2, "d": "nan"}}
