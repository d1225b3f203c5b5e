"""Lines over gaps and over targets, with the numbers of made-up settings."""

import numpy as np
import pytest
from finished_runs import setting

from neural_sim.studies.experiments.levels import levels_entries, levels_figure
from neural_sim.studies.experiments.measured import table

METHODS = (("neural_sim", 0.75), ("lts", 0.5))


def test_a_panel_is_an_object_and_a_line_a_method_over_the_gaps_in_their_order():
    gaps = [setting(gap=gap, methods=METHODS) for gap in ("disjoint", "same")]
    figure = levels_figure([*gaps, setting(gap="uniform")], "gap")
    panels = figure.axes
    assert [axes.get_title() for axes in panels] == ["gap: can", "gap: mug"]
    for axes, ns in zip(panels, (25, 50), strict=True):
        assert [tick.get_text() for tick in axes.get_xticklabels()] == ["the target's", "uniform", "disjoint"]
        lines = {line.lines[0].get_color(): line.lines[0].get_ydata() for line in axes.containers}
        assert lines["#2f6db5"] == pytest.approx([75, 75, 75], abs=1)
        assert np.asarray(lines["#c23b3b"])[[0, 2]] == pytest.approx([50, 50], abs=1)
        assert np.isnan(np.asarray(lines["#c23b3b"])[1]), "LTS was not run from the uniform start"
        assert lines["#22262b"] == pytest.approx([ns, ns, ns], abs=1.7)  # of 60 images, 25 % are 15
    assert [text.get_text() for text in figure.legends[0].texts] == ["NS", "LTS", "NSO", "matched"]


def test_one_setting_shows_every_method_beside_the_others_and_a_dash_for_matched():
    (axes, _) = levels_figure([setting(gap="same", methods=METHODS)], "gap").axes
    lines = [line.lines[0] for line in axes.containers]
    places = [line.get_xdata()[0] for line in lines if line.get_marker() == "o"]
    assert len({round(float(x), 6) for x in places}) == len(places) == 3
    (matched,) = [line for line in lines if line.get_marker() == "_"]
    assert matched.get_xdata() == [0] and matched.get_markersize() > 10


def test_targets_are_in_the_order_of_their_bins():
    made = [setting(gap=gap, target=target) for target in (3, 1) for gap in ("disjoint", "uniform")]
    titles = [axes.get_title() for axes in levels_figure(made, "target").axes]
    assert titles == [
        f"gap: {name}, from the {start} start" for start in ("uniform", "disjoint") for name in ("can", "mug")
    ]
    entries = levels_entries(made, "target")
    assert [[e.cells[c] for c in ("object", "start", "bins of the target")] for e in entries[:4]] == [
        [name, "uniform", target] for name in ("can", "mug") for target in ("1", "3")
    ]
    assert sorted(entries, key=lambda entry: entry.place) == entries
    assert entries[0].line.startswith("gap, can, uniform start, target 1: NSO 75.")


@pytest.mark.parametrize("score", ["AP", "accuracy"])
def test_the_axis_names_what_detectors_and_classifiers_are_scored_by(score):
    axes = levels_figure([setting(gap="same", score=score)], "gap").axes
    assert axes[0].get_ylabel() == f"{score} on the test set (%)"


def test_table_and_summary_have_the_scores_of_every_object():
    made = [setting(gap="same"), setting(gap="disjoint", methods=METHODS, commit="1234567")]
    entries = levels_entries(made, "gap")
    head, _, *rows = table(entries).splitlines()
    assert head == "| experiment | object | initial distribution | seeds | NS | LTS | NSO | matched |"
    assert len(rows) == 4 and rows[0].startswith("| gap | can | the target's | 0 | 25.")
    assert rows[0].split(" | ")[5] == "", "LTS was not run at this gap"
    assert [entry.commits for entry in entries] == [["unknown"], ["1234567"]] * 2
    lines = [entry.line for entry in entries if entry.line]
    assert [line.split(":")[0] for line in lines] == ["gap, can", "gap, mug"]
    assert all("NSO 75." in line and "LTS by 2" in line and "matched" not in line for line in lines)
