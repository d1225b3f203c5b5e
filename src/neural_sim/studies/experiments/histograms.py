"""Learned and target distributions (the paper's Fig. 7) and total variation over seeds.

Bins that look alike are merged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from neural_sim.parameter.distributions import merged
from neural_sim.report import figures
from neural_sim.report.figures import Figure
from neural_sim.report.intervals import Estimate, over_seeds
from neural_sim.studies.experiments.levels import short
from neural_sim.studies.experiments.measured import Entry
from neural_sim.studies.experiments.settings import Setting, modes


@dataclass(frozen=True)
class Histogram:
    """Distributions of one factor of one object, from one start.

    Args:
        experiment: experiment of the runs.
        name: name of the object.
        factor: the learned factor.
        start: short name of the initial distribution.
        aim: short name of the target distribution.
        seeds: seeds of the runs.
        groups: groups of bins, numbered from 1, that look the same.
        p: initial, target and learned probabilities.
        distance: mean total variation from the target, of the initial and of the learned distribution.
        commits: code commits of the runs.
    """

    experiment: str
    name: str
    factor: str
    start: str
    aim: str
    seeds: tuple[int, ...]
    groups: Sequence[Sequence[int]]
    p: Mapping[str, Float[np.ndarray, "seeds _"]]
    distance: Mapping[str, Estimate]
    commits: Sequence[str]


def histograms(settings: Sequence[Setting]) -> Iterator[Histogram]:
    """Read every biased object and factor from the reference method's runs."""
    for setting in settings:
        for name in setting.objects:
            for factor in setting.factors(name):
                yield _histogram(setting, name, factor)


def _histogram(setting: Setting, name: str, factor: str) -> Histogram:
    runs = setting.of_reference
    own = [run["psi"][name][factor] for run in runs]
    bins = range(1, len(own[0]["target"]) + 1)
    groups = runs[0].get("symmetric_bins", {}).get(name, {}).get(factor) or [[b] for b in bins]
    p = {
        which: merged(torch.tensor([each[which] for each in own]), groups).numpy()
        for which in ("initial", "learned", "target")
    }
    away = [run["total_variation"][name][factor] for run in runs]
    distance = {
        which: over_seeds(np.asarray([each[which] for each in away])).as_fraction
        for which in ("initial", "learned")
    }
    start, aim = (modes(setting.distribution(which, name, factor)) for which in ("initial", "target"))
    seeds = tuple(run["seed"] for run in runs)
    return Histogram(
        setting.experiment, name, factor, start, aim, seeds, groups, p, distance, setting.commits
    )


def histogram_figure(all_of: Sequence[Histogram]) -> Figure:
    """Draw one panel per start: initial, learned (mean, smallest and largest over seeds) and target probabilities."""
    columns = min(3, len(all_of))
    rows = -(-len(all_of) // columns)
    figure = Figure(figsize=(3.7 * columns, 2.4 * rows + 0.6), layout="constrained")
    colours = {"initial": figures.METHOD_COLOURS["ns"], "learned": figures.METHOD_COLOURS["learned"],
               "target": figures.METHOD_COLOURS["matched"]}  # fmt: skip
    handles = []
    for number, each in enumerate(all_of, 1):
        axes, x = figure.add_subplot(rows, columns, number), np.arange(len(each.groups))
        handles = []
        for i, (which, colour) in enumerate(colours.items()):
            p = each.p[which]
            mean = p.mean(0)
            spread = None
            if which == "learned" and len(p) > 1:  # the mean of equal numbers may round past them
                spread = np.stack([mean - p.min(0), p.max(0) - mean]).clip(min=0.0)
            bars = axes.bar(x + 0.28 * (i - 1), mean, 0.26, yerr=spread, color=colour, capsize=2,
                            error_kw={"linewidth": 0.8, "ecolor": figures.INK})  # fmt: skip
            handles.append(bars)
        labels = ["=".join(map(str, group)) for group in each.groups]
        axes.set_xticks(x, labels)
        axes.set(ylim=(0, 1))
        title = f"{short(each.name)}, {each.factor}: target {each.aim}, from {each.start}"
        axes.set_title(title, fontsize=8.5, color=figures.INK)
        axes.yaxis.grid(color=figures.GRID)
        axes.set_axisbelow(True)
        figures.style(axes)
    figure.legend(handles, list(colours), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def distance(estimate: Estimate) -> str:
    """Write a total variation with its interval."""
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.2f}"
    return f"{estimate.value:.2f} ({estimate.low:.2f} to {estimate.high:.2f})"


def histogram_entries(all_of: Sequence[Histogram]) -> list[Entry]:
    """Return total variation to the target, with 95 % intervals over seeds."""
    made = []
    for h in all_of:
        initial, learned = (distance(h.distance[which]) for which in ("initial", "learned"))
        cells = {
            "experiment": h.experiment, "object": short(h.name), "factor": h.factor, "target": h.aim, "start": h.start,
            "seeds": ", ".join(map(str, h.seeds)), "initial": initial, "learned": learned,
        }  # fmt: skip
        line = f"{short(h.name)}, {h.factor} target {h.aim} from {h.start}: total variation {initial} to {learned}"
        made.append(Entry((h.experiment, h.name, h.factor, h.aim, h.start), cells, line, h.commits))
    return made
