"""The figure, the table and the record of `+experiment=gumbel_temperature`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from neural_sim.outer.temperatures import AtTemperature, Truth
from neural_sim.report import figures, tracking
from neural_sim.report.figures import INK, METHOD_COLOURS, MUTED

BIAS, SPREAD = METHOD_COLOURS["learned"], "#e08a1e"
LEAST = 1e-2
"""Lower limit of the figure, in lengths of the derivative."""


def report_temperatures(
    rows: Sequence[AtTemperature],
    truths: Sequence[Truth],
    experiment: str,
    seed: int,
    config: Mapping[str, Any],
    uri: str,
    folder: Path,
    begun: float,
) -> tracking.Run:
    """Figure, temperatures.md and temperatures.json in ``folder``, and a run in MLflow that began at ``begun`` (seconds
    since 1970).
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        key: [dataclasses.asdict(x) for x in entries] for key, entries in (("rows", rows), ("truths", truths))
    }
    (folder / "temperatures.json").write_text(json.dumps(document, indent=1))
    text = table(rows, truths)
    (folder / "temperatures.md").write_text(text + "\n")
    figures.save(temperature_figure(rows, truths), folder / "figures" / "temperatures.png")
    series = {
        f"{row.object}/{key}": [getattr(other, key) for other in rows if other.object == row.object]
        for row in rows
        for key in ("bias", "spread", "cosine")
    }
    tags = {"method": "pathwise", "seed": str(seed)}
    print(text)
    parameters = tracking.flatten(config)
    return tracking.log_run(uri, experiment, f"seed {seed}", tags, parameters, {}, series, folder, begun)


def table(rows: Sequence[AtTemperature], truths: Sequence[Truth]) -> str:
    """Markdown: everything relative to the length of the truth."""
    lines = [
        f"Estimates of d/dpsi <dL_train/dtheta, v> from {rows[0].images} images, in lengths of the derivative over "
        "hard bins."
    ]
    for truth in truths:
        lines += [
            "",
            f"**{truth.object}**: truth {truth.length:.2g}, known to {truth.noise / truth.length:.0%}; the stratified "
            f"estimator's spread is {truth.spread / truth.length:.2f}.",
            "",
            "| temperature | bias | spread | cosine of the mean | draws where p puts them |",
            "|---|---|---|---|---|",
        ]
        for row in (row for row in rows if row.object == truth.object):
            lines.append(
                f"| {row.temperature:g} | {row.bias / truth.length:.2f} ± {row.bias_error / truth.length:.2f} "
                f"| {row.spread / truth.length:.2f} | {row.cosine:.2f} | {agreement(row, truth):.0%} |"
            )
    return "\n".join(lines)


def agreement(row: AtTemperature, truth: Truth) -> float:
    """1 - total variation between where relaxed draws lie and p."""
    return 1.0 - 0.5 * float(np.abs(np.subtract(row.frequencies, truth.probabilities)).sum())


def temperature_figure(rows: Sequence[AtTemperature], truths: Sequence[Truth]) -> Figure:
    """For each object: above, where relaxed draws lie at every temperature, beside p; below, bias and spread."""
    figure = Figure(figsize=(3.6 * len(truths) + 0.6, 5.6), layout="constrained")
    grid = figure.subplots(2, len(truths), squeeze=False)
    for column, truth in enumerate(truths):
        own = [row for row in rows if row.object == truth.object]
        _frequencies(grid[0, column], own, truth)
        _errors(grid[1, column], own, truth, column == 0)
    figure.suptitle(
        f"Gumbel-softmax: relaxed draws, and the derivative from {rows[0].images} of them",
        color=INK,
        fontsize=11,
    )
    handles, labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8, labelcolor=INK
    )
    return figure


def _frequencies(axes: Any, rows: Sequence[AtTemperature], truth: Truth) -> None:
    values = np.array([*(row.frequencies for row in rows), truth.probabilities])
    axes.imshow(values, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for (y, x), value in np.ndenumerate(values):
        if value >= 0.005:
            colour = "white" if value > 0.5 else INK
            axes.text(x, y, f"{100 * value:.0f}", ha="center", va="center", fontsize=7, color=colour)
    axes.axhline(len(rows) - 0.5, color="white", linewidth=3)
    axes.set_yticks(range(len(values)), [*(f"τ = {row.temperature:g}" for row in rows), "p"])
    axes.set_xticks(range(values.shape[1]), [str(bin + 1) for bin in range(values.shape[1])])
    axes.set_title(f"{truth.object}: draws by bin, %", color=INK, fontsize=9)
    figures.style(axes)
    axes.tick_params(length=0)


def _errors(axes: Any, rows: Sequence[AtTemperature], truth: Truth, first: bool) -> None:
    at = [row.temperature for row in rows]
    bias, error, spread = (
        np.array([getattr(row, key) for row in rows]) / truth.length
        for key in ("bias", "bias_error", "spread")
    )
    axes.plot(at, spread, "o-", color=SPREAD, markersize=4, label="spread of one estimate")
    low = np.minimum(error, np.maximum(bias - LEAST, 0.0))
    axes.errorbar(
        at,
        np.maximum(bias, LEAST),
        yerr=[low, error],
        fmt="s",
        color=BIAS,
        markersize=4,
        capsize=2,
        label="bias",
    )
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle="--", label="the derivative over hard bins itself")
    axes.axhline(
        truth.spread / truth.length,
        color=MUTED,
        linewidth=0.8,
        linestyle=":",
        label="spread of the stratified estimator",
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=LEAST)
    axes.set_xlabel("temperature", color=INK, fontsize=8)
    if first:
        axes.set_ylabel("in lengths of the derivative", color=INK, fontsize=8)
    figures.style(axes)
