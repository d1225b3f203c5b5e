"""What the experiment leaves: the JSON's rows, the tables written from it, figures, MLflow."""

import json
import math

import pytest
from matplotlib import image
from mlflow import MlflowClient

from neural_sim.studies.work_precision.measurement import Order, Point, Series
from neural_sim.studies.work_precision.report import (
    brief,
    document,
    figure,
    markdown,
    publish,
    slug,
    text_of,
    write_docs,
)

MACHINE = {"processor": "a processor", "torch": "9.9", "threads": 1, "load": 0.5}
SERIES = (
    Series(
        "renderer/opacity", "mean error of opacity",
        (
            Point("draft", 0.1, 1.0, 2.0, line="quality", detail="few samples"),
            Point("final", 0.01, 4.0, 3.0, default=True, line="quality"),
            Point("clever", 0.01, 2.0, None, line="other"),
            Point("broken", math.nan, 1.0, line="other"),
            Point("exact", 0.0, 9.0, line="other"),
        ),
        (Order("quality", 1.98, 2.0, "0.1 to 0.01 radii"), Order("other", math.nan, 1.0, "none resolves it")),
        "Against everything.",
    ),
    Series("field/grid", "error", (Point("one", 1.0, 1.0, default=True),)),
)  # fmt: skip


def test_the_document_has_a_row_a_setting_and_what_beats_a_default():
    held = document(SERIES, MACHINE)
    assert json.loads(json.dumps(held, allow_nan=False)) == held
    rows = {row["setting"]: row for row in held["series"] if row["name"] == "renderer/opacity"}
    wanted = {"name", "setting", "error", "error_kind", "seconds", "memory_mb", "default", "pareto"}
    assert all(wanted <= set(row) for row in held["series"])
    assert [name for name, row in rows.items() if row["pareto"]] == ["draft", "clever", "exact"]
    assert rows["broken"]["error"] is None and rows["clever"]["memory_mb"] is None
    (beaten,) = held["overtaken"]
    assert (beaten["default"], beaten["by"], beaten["error_ratio"], beaten["seconds_ratio"]) == (
        "final",
        "clever",
        1,
        2,
    )
    assert [order["observed"] for order in held["orders"]] == [1.98, None]


def test_the_tables_are_written_from_the_json_alone():
    held = json.loads(json.dumps(document(SERIES, MACHINE)))
    text = markdown(held, "renderer")
    assert (
        "| **final** (default) | 0.01 | 4 | 3 |  |  |" in text
        and "| broken | not a number | 1 |  |  |  |" in text
    )
    assert "| draft | 0.1 | 1 | 2 | yes | few samples |" in text
    assert "Order of quality for steps of 0.1 to 0.01 radii: 1.98, in theory 2." in text
    assert "final, is not Pareto-optimal: clever has the same error and takes 0.50 of the time." in text
    assert "field" not in text and "a processor" in text


@pytest.mark.parametrize(
    ("error", "words"), [(0.99, "1% less error"), (0.4, "2.5 times less error"), (0.0, "no error")]
)
def test_how_much_better_a_setting_is_than_the_default(error, words):
    two = (Point("default", 1.0, 4.0, None, True, "a"), Point("clever", error, 2.0, None, False, "a"))
    held = document([Series("field/can", "error", two, ())], MACHINE)
    assert f"clever has {words} and takes 0.50 of the time." in markdown(held, "field")


def test_files_figures_and_metrics(context):
    held = document(SERIES, MACHINE)
    run = publish(context, SERIES, held)
    assert (context.folder / "work_precision.md").read_text() == text_of(held) + "\n"
    assert json.loads((context.folder / "work_precision.json").read_text()) == held
    names = {path.stem for path in (context.folder / "figures").glob("*.png")}
    assert names == {slug(series.name) for series in SERIES} == {"renderer_opacity", "field_grid"}
    assert image.imread(context.folder / "figures" / "renderer_opacity.png").std() > 0.01
    axes = figure(SERIES[0]).axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["quality", "other"]
    metrics = MlflowClient(context.uri).get_run(run.run_id).data.metrics
    assert metrics["renderer_opacity/default_error"] == 0.01
    assert metrics["renderer_opacity/defaults_not_optimal"] == 1.0
    assert metrics["renderer_opacity/order_quality"] == 1.98


def test_a_page_s_table_has_the_default_and_what_takes_as_long_on_every_other_line():
    given = Series("renderer/given", "error", (Point("alone", 1.0, 1.0, line="quality"),))
    text = brief(document((*SERIES, given), MACHINE), "renderer")
    row = "| opacity: mean error of opacity | **final**: 0.01 in 4 s | **clever**: 0.01 in 2 s |"
    assert row in text and "draft" not in text and "given" not in text
    assert (
        "Observed orders of convergence (in theory): opacity, quality 1.98 (2); opacity, other none (1)."
        in text
    )
    assert "final, is not Pareto-optimal: clever" in text and "*opacity*: Against everything." in text
    assert "**one**: 1 in 1 s |  |" in brief(document(SERIES, MACHINE), "field")
    assert "**alone**: 1 in 1 s |" in brief(document((given,), MACHINE), "renderer")


def test_a_page_gets_a_section_for_each_family_that_was_measured(tmp_path):
    page = tmp_path / "numerics.md"
    page.write_text("kept\n")
    held = document(SERIES, MACHINE)
    for _ in range(2):  # the second replaces the first
        write_docs(held, page, "python -m src.main +experiment=work_precision")
    text = page.read_text()
    assert text.startswith("kept\n") and text.count("## Error against run time: renderer\n") == 1
    assert text.count("## Error against run time: field\n") == 1
    whole = json.loads((tmp_path / "numerics.json").read_text())
    assert list(whole) == ["renderer", "field"] and whole["renderer"] == markdown(held, "renderer")
    assert "    python -m src.main +experiment=work_precision\n" in text


def test_a_page_that_has_sections_gets_no_others(tmp_path):
    page = tmp_path / "numerics.md"
    name = "Error against run time: field"
    page.write_text(f"kept\n<!-- begin: {name} -->\nold\n<!-- end: {name} -->\n")
    write_docs(document(SERIES, MACHINE), page, "python -m src.main +experiment=work_precision")
    text = page.read_text()
    assert "old" not in text and f"## {name}\n" in text and "renderer" not in text
    assert list(json.loads((tmp_path / "numerics.json").read_text())) == ["renderer", "field"]
