"""Learned beside target distributions over seeds, bins that look the same as one."""

import numpy as np
import pytest
from finished_runs import dominant, setting

from neural_sim.studies.experiments.histograms import histogram_entries, histogram_figure, histograms
from neural_sim.studies.experiments.measured import table

HALF = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]


def test_bins_that_look_the_same_are_one():
    groups = {"can": {"pose": [[1, 8], [2, 7], [3, 6], [4, 5]]}}
    can, mug = histograms([setting(learned=HALF, symmetric_bins=groups)])
    assert (can.name, can.start, can.aim, can.factor) == ("can", "4", "1", "pose")
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
