"""Charts with the numbers of made-up settings: lines over gaps and targets, learned and target distributions."""

import numpy as np
import pytest
from finished_runs import dominant, setting

from neural_sim.studies.experiments.charts import (
    histogram_entries,
    histogram_figure,
    histograms,
    levels_entries,
    levels_figure,
)
from neural_sim.studies.experiments.results import Setting, table

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


def test_settings_of_two_targets_do_not_stand_for_each_other():
    """One experiment, whose command line moved the target: both are shown, and named by their targets."""
    made = [setting(target=target, commit=f"of{target}") for target in (3, 1)]
    entries = levels_entries(made, "gap")
    assert [(e.cells["object"], e.cells["target"], *e.commits) for e in entries] == [
        (name, target, f"of{target}") for name in ("can", "mug") for target in ("1", "3")
    ]
    assert entries[0].line.startswith("gap, can, target 1: NSO 75.")
    titles = [axes.get_title() for axes in levels_figure(made, "gap").axes]
    assert titles == [f"gap: {name}, target {target}" for name in ("can", "mug") for target in (1, 3)]


def test_of_two_settings_at_one_place_the_newest_is_shown_and_the_other_named(caplog):
    made = [setting(commit="newest"), setting(commit="older", initial=6)]
    entries = levels_entries(made, "gap")
    assert [entry.commits for entry in entries] == [["newest"]] * 2
    assert "gap: can has older settings at disjoint, which are left out" in caplog.text


def test_methods_without_a_colour_of_their_own_can_be_told_apart():
    methods = (("neural_sim", 0.75), ("response", 0.5), ("label_shift", 0.6))
    lines = levels_figure([setting(methods=methods)], "gap").axes[0].containers
    assert len({line.lines[0].get_color() for line in lines}) == len(lines) == 5


def test_lines_name_the_reference_that_was_asked_for():
    runs = setting(methods=METHODS).group
    verdict = Setting.of(runs, "lts", draws=5).verdict("can")
    assert verdict.startswith("LTS 5") and "NSO by -2" in verdict


HALF = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]


def test_bins_that_look_the_same_are_one():
    groups = {"can": {"pose": [[1, 8], [2, 7], [3, 6], [4, 5]]}}
    can, mug = histograms([setting(learned=HALF, symmetric_bins=groups)])
    assert (can.name, can.short("initial"), can.short("target"), can.factor) == ("can", "4", "1", "pose")
    assert can.p["learned"].tolist() == [[1.0, 0.0, 0.0, 0.0]]
    assert can.p["target"] == pytest.approx(np.array([[0.88, 0.04, 0.04, 0.04]]))
    assert mug.groups == [[b] for b in range(1, 9)] and mug.p["learned"].tolist() == [HALF]


def test_total_variation_has_an_interval_over_seeds():
    runs = [setting(seeds=(0, 1, 2)), setting(seeds=(0,), learned=dominant(2))]
    spread, single = list(histograms(runs))[::2]
    assert (spread.distance["learned"].value, spread.distance["learned"].high) == (0.0, 0.0)
    assert spread.distance["initial"].value == pytest.approx(0.84)  # 0.86 - 0.02, of two dominant bins
    assert single.distance["learned"].value == pytest.approx(0.84) and single.distance["learned"].low is None
    entries = histogram_entries([spread, single])
    rows = table(entries).splitlines()
    assert rows[2] == "| gap | can | pose | 1 | 4 | 0, 1, 2 | 0.84 (0.84 to 0.84) | 0.00 (0.00 to 0.00) |"
    assert rows[3].endswith("| 0 | 0.84 | 0.84 |")
    assert entries[1].line == "can, pose target 1 from 4: total variation 0.84 to 0.84"
    assert entries[1].place == ("gap", "can", "pose", "1", "4") and entries[1].commits == ["unknown"]


def test_bars_are_the_probabilities():
    figure = histogram_figure(list(histograms([setting(learned=HALF)])))
    axes = figure.axes[0]
    initial, learned, target = [[bar.get_height() for bar in bars.patches] for bars in axes.containers]
    assert (
        learned == pytest.approx(HALF)
        and target == pytest.approx(dominant(1))
        and initial == pytest.approx(dominant(4))
    )
    assert [tick.get_text() for tick in axes.get_xticklabels()] == [str(b) for b in range(1, 9)]


@pytest.mark.parametrize(
    ("seeds", "learned"), [((0, 1, 2), dominant(1)), ((0, 1, 2, 3, 4), [0.23, *[0.11] * 7])]
)
def test_seeds_that_agree_have_bars_without_a_spread(seeds, learned):
    """The mean of equal numbers can differ from them by a rounding error, which is no length of a bar."""
    figure = histogram_figure(list(histograms([setting(seeds=seeds, learned=learned)])))
    (bars,) = (each for each in figure.axes[0].containers if getattr(each, "errorbar", None) is not None)
    assert [bar.get_height() for bar in bars.patches] == pytest.approx(learned)
    for segment in bars.errorbar.lines[2][0].get_segments():
        assert segment[0, 1] == pytest.approx(segment[1, 1], abs=1e-6)
