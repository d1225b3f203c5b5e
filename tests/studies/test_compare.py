"""A whole comparison of small made-up runs, from MLflow to compare.md, compare.json and the page."""

import html
import json
import re
import shutil
from dataclasses import replace

import pytest

from neural_sim.report import tracking
from neural_sim.report.comparison import NOTE, ONLY_AT_END, SECONDS, Comparison, Costs
from neural_sim.report.intervals import Estimate
from neural_sim.report.runs import FinishedRun, Group, LeftOut, Runs
from neural_sim.studies.compare import Compare, Table, verdict, write_page
from neural_sim.tasks.context import Context

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


def log_files(uri, name, folder):
    with tracking.opened(uri, "gap", name, {}, {}) as run:
        run.log_files(folder)


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
        log_files(uri, f"{held['method']} seed {held['seed']}", run)
    return uri


def compared(uri, folder, **settings):
    """The comparisons of a study that has written its files."""
    study = Compare(("gap",), **settings)
    config = {"name": "compare", "seed": 0, "paths": {"mlflow": uri}}
    study.run(Context(config, folder, lambda: pytest.fail("no experiment is asked for"), ("compare",)))
    groups, _ = study.selected(Runs.read(uri, ["gap"]))
    return [study.table(group, 0).comparison for group in groups]


def test_a_later_smoke_run_changes_no_table_and_is_named(database, tmp_path, capsys):
    (found,) = compared(database, tmp_path, draws=5)
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
    assert text.strip() in printed and tracking.where_runs(database, "gap") in printed
    page = tmp_path / "report.html"
    assert (
        printed.strip().endswith(f"open {page}") and "neural_sim reaches 75.2 AP" in page.read_text()
    )  # 76 of 101 recalls
    (own,) = tracking.logged_runs(database, "compare")
    assert own.status == "FINISHED" and {"compare.md", "compare.json", "figures"} <= own.files


def test_classifiers_are_compared_by_accuracy(context, tmp_path):
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
        log_files(context.uri, method, run)
    (comparison,) = compared(context.uri, tmp_path / "compare", draws=20)
    assert (comparison.ap["neural_sim"].value, comparison.ap["lts"].value) == (0.75, 0.5)
    ahead = comparison.ahead["lts"]
    assert ahead.value == 0.25 and 0.0 <= ahead.low < 0.25 < ahead.high <= 0.75
    text, page = ((tmp_path / "compare" / name).read_text() for name in ("compare.md", "report.html"))
    assert "**" not in text and "None is in bold: intervals of one seed" in text
    assert "Top-1 accuracy of mug in points" in text and "| method | accuracy |" in text
    assert "neural_sim reaches 75.0 points of accuracy" in page
    assert "AP" not in text and "<th>AP" not in page


def test_two_ways_of_scoring_are_two_tables_whose_headings_say_how_they_differ(database, tmp_path):
    found = compared(database, tmp_path, reference="lts", draws=5)
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
        compared(database, tmp_path, reference="ours", draws=5)
    with pytest.raises(ValueError, match="no experiment 'other'"):
        Runs.read(database, ["other"])
    with pytest.raises(ValueError, match=r"compare\.methods: no run of typo in gap"):
        compared(database, tmp_path, draws=5, methods=("typo",))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("results.json", '{"method": "lts", "se', r"results\.json: not readable as JSON"),
        ("results.json", "[]", r"its results\.json holds no results of a run"),
        ("detections.json", "", r"lts seed 0 \(\w{8}\) of gap: \S+detections\.json: not readable as JSON"),
        ("detections.json", '{"images": 8}', r"detections\.json: want the images, truth and detections of a run"),
        ("detections.json", '{"images": 1, "truth": []}', r"detections\.json: holds no detections of the learned"),
        ("detections.json", '{"images": 0, "truth": []}', r"detections\.json: want the images, truth and"),
    ],
)  # fmt: skip
def test_a_damaged_file_of_a_run_is_named(name, content, said, context, tmp_path):
    """Without its results a run is left out; detections are read only of what is compared, which needs them."""
    for method in ("neural_sim", "lts"):
        run = tmp_path / method
        run.mkdir()
        (run / "results.json").write_text(json.dumps(results(method, 0, 0.5)))
        (run / "detections.json").write_text(json.dumps(detections(4)))
        if method == "lts":
            (run / name).write_text(content)
        log_files(context.uri, f"{method} seed 0", run)
    if name == "detections.json":
        with pytest.raises(ValueError, match=said) as refused:
            compared(context.uri, tmp_path / "compare", draws=5)
        assert "\n" not in str(refused.value)
        return
    compared(context.uri, tmp_path / "compare", draws=5)
    (left,) = json.loads((tmp_path / "compare" / "compare.json").read_text())["left_out"]
    assert left["run"] == "lts seed 0" and re.search(said, left["reason"])


def test_seconds_of_several_kinds_of_device_are_called_so(context, tmp_path):
    for method, kind in (("neural_sim", "gpu"), ("lts", "cpu")):
        run = tmp_path / method
        run.mkdir()
        held = results(method, 0, 0.5, config={"trainer": {"accelerator": kind}})
        (run / "results.json").write_text(json.dumps(held))
        (run / "detections.json").write_text(json.dumps(detections(4)))
        log_files(context.uri, method, run)
    compared(context.uri, tmp_path / "compare", draws=5)
    text = (tmp_path / "compare" / "compare.md").read_text()
    assert "Seconds are not comparable" in text and "cpu: lts seed 0" in text


@pytest.fixture
def comparison():
    methods = ("ours", "first", "second", "third")
    ahead = {
        "first": Estimate(0.2, 0.1, 0.3),
        "second": Estimate(-0.1, -0.2, -0.05),
        "third": Estimate(0.01, -0.1, 0.1),
    }
    return Comparison(
        "gap", (0, 1), methods, "ours", {m: Estimate(0.5, 0.4, 0.6) for m in (*methods, "ns", "matched")},
        {m: Estimate(0.9, 0.8, 1.0) for m in methods}, ahead, {"first": Estimate(0.2, 0.1, 0.3)},
        {m: {"images": 10.0, "detector_steps": 5.0, "products": 1.0, "seconds": 7.0} for m in methods},
        {m: Estimate(0.45) for m in methods}, 6.0, [5.0, 60.0],
        {"first": [Estimate(0.05, -0.1, 0.2), Estimate(0.15, 0.11, 0.2)]},
    )  # fmt: skip


def page_of(comparison, folder, heading="", spent=(), left_out=()):
    curve = [{"images": 10.0, "seconds": 7.0, "ap": {"per_class": {"mug": 0.5}}}]
    runs = tuple(
        FinishedRun({"method": m, "seed": 0, "biased": ["mug"], "curve": curve}) for m in comparison.methods
    )
    table = Table(Group("gap", "gap", heading, runs), comparison, dict(spent))
    return write_page([table], left_out, folder).read_text()


def test_the_verdict_names_who_is_ahead_behind_and_not_told_apart(comparison):
    assert verdict(comparison) == (
        "ours reaches 50.0 AP (40.0 to 60.0), ahead of first by 20.0, behind second by 10.0, "
        "not told apart from third."
    )
    one = verdict(replace(comparison, seeds=(3,)))
    assert one.endswith("from third; from one seed, whose intervals leave out how much trainings differ.")


def test_leads_of_runs_that_were_scored_once_do_not_stand_out(comparison, tmp_path):
    once = replace(comparison, only_at_end=True)
    page = page_of(once, tmp_path)
    assert ONLY_AT_END in page and page.count('class="accepted"') == 1 and page.count('class="rejected"') == 1


def test_a_page_has_every_method_and_what_was_left_out(comparison, tmp_path):
    spent = {"first": Costs(dict.fromkeys(SECONDS, 3.0), 12.0, 700.0, None)}
    page = page_of(
        comparison, tmp_path, "size=<1>", spent, [LeftOut("a run", "0" * 8, "gap", "older & smaller")]
    )
    assert "size=&lt;1&gt;" in page and "older &amp; smaller" in page  # escaped
    assert all(f"<th>{method}</th>" in page for method in comparison.methods)
    assert "data:image/svg+xml;base64," in page and not re.findall(r'(?:src|href)="(?!data:)', page)
    assert '<td class="accepted">\n20.0' in page or re.search(r'class="accepted">\s*20\.0', page)
    assert re.search(r'class="rejected">\s*-10\.0', page)
    cells = "".join(f'<td class="n">{cell}</td>' for cell in [*["3"] * len(SECONDS), "700", "12", ""])
    assert f"<tr><th>first</th>{cells}</tr>" in page and NOTE in html.unescape(page)
    row = page.split("<tr><th>ours ahead after (s), of</th>")[1]
    assert re.match(r'<th class="n">5</th><th class="n">60</th></tr>\s*<tr><th>first</th>\s*<td>\s*5\.0', row)
    assert re.search(r'<td class="accepted">\s*15\.0 <span class="note">\(11\.0 to 20\.0\)', row)
    assert "95 %, over seeds and test images" in page


def test_differences_of_one_seed_do_not_stand_out(comparison, tmp_path):
    page = page_of(replace(comparison, seeds=(0,)), tmp_path)
    assert 'class="accepted"' not in page and 'class="rejected"' not in page
    assert "95 %, over test images alone" in page and re.search(r"<td>\s*20\.0", page)
