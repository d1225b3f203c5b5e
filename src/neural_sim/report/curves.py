"""What methods have reached against what they have spent."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from neural_sim.report import figures
from neural_sim.report.finished import FinishedRun
from neural_sim.report.statistics import Comparison, biased_ap

UNITS = {"images": "images", "seconds": "seconds", "cpu_seconds": "seconds of processor time"}


def curves(comparison: Comparison, runs: Sequence[FinishedRun]) -> Figure:
    """The biased objects' score against images and against seconds, a line a seed."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    figure.suptitle(comparison.setting, color=figures.INK, fontsize=11)
    for place, key in enumerate(("images", comparison.clock), 1):
        axes = figure.add_subplot(1, 2, place)
        for number, method in enumerate(comparison.methods):
            colour = figures.CLASS_COLOURS[number % len(figures.CLASS_COLOURS)]
            mine = [run for run in runs if run.method == method]
            for line, run in enumerate(mine):
                spent = [point[key] for point in run.results["curve"]]
                label = method if line == 0 else None
                axes.plot(
                    spent,
                    100 * biased_ap(run, comparison.clock)[1],
                    ".-",
                    drawstyle="steps-post",  # worth what it has reached, as in the area
                    color=colour,
                    alpha=0.7,
                    linewidth=1,
                    label=label,
                )
        for bound, style in zip(comparison.bounds, (":", "--"), strict=False):
            axes.axhline(100 * comparison.ap[bound].value, color=figures.MUTED, linestyle=style, linewidth=1)
            axes.annotate(bound, (1.0, 100 * comparison.ap[bound].value), xycoords=("axes fraction", "data"),
                          ha="right", va="bottom", fontsize=7, color=figures.MUTED)  # fmt: skip
        # The start, where nothing is spent yet, has a place too.
        least = [p[key] for run in runs for p in run.results["curve"] if p[key] > 0]
        axes.set_xscale("symlog", linthresh=min(least, default=1))
        axes.set(
            xlabel=f"{UNITS[key]} (log)",
            ylabel=f"{comparison.score} of the biased objects (%)",
            xlim=(0, None),
        )
        axes.grid(color=figures.GRID)
        figures.style(axes)
        handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside right upper", fontsize=8, frameon=False)
    return figure
