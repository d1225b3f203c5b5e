"""The page's charts, as SVG with text that stays text."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from neural_sim.detector.protocol import Score
from neural_sim.report import figures


def data_uri(figure: Figure) -> str:
    """The figure as the source of an ``<img>``, which keeps its ids apart from those of other figures."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "neural-sim"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()


def bin_colours(factor: str, bins: int) -> list[str]:
    """The colours of a factor's bins in these charts, for a legend."""
    return [to_hex(colour) for colour in figures.bin_colours(factor, bins)]


def psi_chart(
    history: Sequence[Sequence[float]],
    target: Sequence[float] | None,
    groups: Sequence[Sequence[int]],
    factor: str,
) -> str:
    """One object's probabilities over the iterations, the target's beside them; arguments as in
    :func:`figures.psi_panel`.
    """
    figure = Figure(figsize=(3.4, 2.1), layout="constrained")
    figures.psi_panel(
        figure.add_subplot(), history, target, groups, figures.bin_colours(factor, len(history[0]))
    )
    return data_uri(figure)


def curve_chart(
    curve: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    bounds: Mapping[str, float],
    score: Score = "AP",
) -> str:
    """The mean score of the classes ``names`` against the method's seconds; ``bounds`` are scores of other detectors by
    name, drawn as lines. Scores as fractions.
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
