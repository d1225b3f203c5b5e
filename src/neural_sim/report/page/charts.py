"""The charts of a run's page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.colors import to_hex

from neural_sim.detector.protocol import Score
from neural_sim.report import figures
from neural_sim.report.figures import Figure
from neural_sim.report.page.render import data_uri
from neural_sim.report.run import Learned


def bin_colours(factor: str, bins: int) -> list[str]:
    """Return the colours of a factor's bins in these charts, for a legend."""
    return [to_hex(colour) for colour in figures.bin_colours(factor, bins)]


def psi_chart(learned: Learned) -> str:
    """Draw one object's probabilities over the iterations, with the target's next to them."""
    figure = Figure(figsize=(3.4, 2.1), layout="constrained")
    figures.psi_panel(figure.add_subplot(), learned)
    return data_uri(figure)


def curve_chart(
    curve: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    bounds: Mapping[str, float],
    score: Score = "AP",
) -> str:
    """Draw the mean score of some classes against the method's seconds.

    Args:
        curve: what was spent and scored, with scores as fractions.
        names: of the classes.
        bounds: scores of other detectors by name, drawn as lines.
        score: what these are.
    """
    figure = Figure(figsize=(6.2, 2.9), layout="constrained")
    axes = figure.add_subplot()
    seconds = [point["seconds"] for point in curve]
    ap = [100.0 * sum(point["ap"]["per_class"][name] for name in names) / len(names) for point in curve]
    axes.plot(seconds, ap, "o-", color=figures.METHOD_COLOURS["learned"], linewidth=1.6, markersize=5)
    for value, spent in zip(ap, seconds, strict=True):
        axes.annotate(f"{value:.1f}", (spent, value), textcoords="offset points", xytext=(0, 6), ha="center",
                      fontsize=8, color=figures.INK)  # fmt: skip
    for name, value in bounds.items():
        axes.axhline(100.0 * value, color=figures.MUTED, linestyle="--", linewidth=1)
        axes.annotate(name, (1.0, 100.0 * value), xycoords=("axes fraction", "data"), ha="right", va="bottom",
                      fontsize=8, color=figures.MUTED)  # fmt: skip
    axes.set(xlabel="seconds of the method, its warm start included", ylabel=f"{score} (%)", xlim=(0, None))
    axes.margins(y=0.2)
    axes.grid(color=figures.GRID)
    figures.style(axes)
    return data_uri(figure)
