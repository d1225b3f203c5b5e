"""Tables over numbers of photographs, with the numbers of made-up settings."""

import pytest
from finished_runs import finished, results
from finished_runs import setting as made_setting

from neural_sim.report.runs import Group
from neural_sim.studies.experiments.layouts import asked, photographs_summary, photographs_table
from neural_sim.studies.experiments.results import Setting


def setting(mode, trained=None, methods=(("neural_sim", 0.75), ("lts", 0.5)), count=None, fraction=None):
    """A setting with ``trained`` photographs; 0.25 of photographs alone, 0.5 of images alone."""
    config = results("shots", "lts", 0)["config"]
    config["training"] = {"real": {"mode": mode, "count": count, "fraction": fraction}}
    real = {} if not trained else {"mode": mode, "photographs": trained}
    rows = {"ns": (0.3, 0.3), "matched": (0.9, 0.9)}
    if real:
        rows |= {"real_only": (0.25, 0.25), "synthetic_only": (0.5, 0.5), "views_only": (0.1, 0.1)}
    runs = tuple(
        finished(
            {**rows, "learned": (ap, ap)}, experiment="shots", method=method, seed=0, config=config, real=real
        )
        for method, ap in methods
    )
    return Setting.of(Group("shots", "shots", "", runs), "neural_sim", draws=20)


def cells(table):
    return {row.split(" | ")[0].strip("| "): row.strip("| ").split(" | ")[1:] for row in table.splitlines()}


SETTINGS = (
    setting("combined", 7, count=25),
    setting("pretrain", None, count=0),
    setting("combined", 7, count=5, methods=(("neural_sim", 0.8),)),
    setting("pretrain", 7, count=25),
)


def test_numbers_of_photographs_are_columns_in_their_order_and_say_where_there_were_fewer():
    assert [asked(s)[1] for s in sorted(SETTINGS, key=asked)] == [
        "0 photographs", "5 photographs", "25 photographs (7 at hand)", "25 photographs (7 at hand)",
    ]  # fmt: skip
    assert asked(setting("combined", 7, fraction=0.05)) == (0.05, "5 % of the photographs (7)")
    assert asked(setting("combined", 70)) == (1.0, "100 % of the photographs (70)")
    assert cells(photographs_table(SETTINGS))["mAP"] == [
        "0 photographs", "5 photographs", "25 photographs (7 at hand)",
    ]  # fmt: skip


def test_rows_are_ways_of_training_and_methods():
    rows = cells(photographs_table(SETTINGS))
    assert list(rows)[2:] == [
        "photographs alone", "views of the fields alone",
        "synthetic alone, NS", "synthetic alone, LTS", "synthetic alone, NSO",
        "synthetic, then photographs, NS", "synthetic, then photographs, LTS", "synthetic, then photographs, NSO",
        "both together, NS", "both together, LTS", "both together, NSO",
    ]  # fmt: skip
    assert [each.split(" ")[0] for each in rows["both together, NSO"]] == ["", "79.2", "75.2"]
    assert rows["photographs alone"][0] == "" and rows["photographs alone"][1].startswith("25.")
    assert rows["views of the fields alone"][0] == "" and rows["views of the fields alone"][1].startswith(
        "10."
    )
    assert rows["synthetic alone, LTS"][0].startswith("50.") and not any(rows["synthetic alone, LTS"][1:])


def test_the_summary_has_a_line_for_each_setting():
    lines = photographs_summary(SETTINGS)
    assert len(lines) == 4 and "photographs alone" not in lines[0]
    assert lines[0].startswith("0 photographs, synthetic alone, seeds 0: NSO 75.2")
    assert "ahead of NS by 44." in lines[3] and "photographs alone 25." in lines[3]


def test_rows_without_the_other_kind_are_in_no_list_of_methods():
    made = SETTINGS[0]
    assert made.methods == ["ns", "lts", "neural_sim", "matched"]
    assert made.columns[4:] == ["synthetic_only", "real_only", "views_only"]
    assert made.score("real_only").value == pytest.approx(0.25, abs=0.01)
    assert "real_only" not in made_setting().columns
