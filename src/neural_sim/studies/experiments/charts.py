"""Charts of scores and distributions, and table rows with the same numbers.

Scores of biased objects are drawn over starts (the paper's Fig. 5) or targets (Fig. 6), and learned distributions next
to the target's (Fig. 7), with their total variation over seeds. Bins that look alike are merged.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from neural_sim.parameter.distributions import merged
from neural_sim.report import figures
from neural_sim.report.figures import Figure
from neural_sim.report.intervals import Estimate, over_seeds, points
from neural_sim.studies.experiments.results import Entry, Setting, called, modes

_log = logging.getLogger(__name__)
Axis = Literal["gap", "target"]
STARTS = {"same": "the target's", "uniform": "uniform", "disjoint": "disjoint"}
"""The starts in the paper's Fig. 5."""
COLOURS = {
    "ns": figures.INK, "lts": "#c23b3b", "auto_sim": "#4c9f70", "neural_sim": "#2f6db5", "matched": figures.MUTED,
}  # fmt: skip
"""Line colours of the methods; others take those of ``OTHERS``, in order."""
OTHERS = ("#7b5cc4", "#d98a1f", "#1f9fb5", "#b5407f", "#8c6d1f")
APART = 0.03
"""Horizontal offset between methods, as a fraction of the distance between ticks."""
LABELS = {"gap": "initial distribution", "target": "bins of the target"}


class Panel(NamedTuple):
    """One panel of a figure.

    ``start`` is the initial distribution, empty if that is the axis. ``aim`` is the target, empty if that is the axis
    or the experiment has only one target for the object.
    """

    experiment: str
    start: str
    name: str
    aim: str

    @property
    def title(self) -> str:
        """The title of the panel."""
        start = f", from the {self.start} start" if self.start else ""
        return f"{self.experiment}: {short(self.name)}{f', target {self.aim}' if self.aim else ''}{start}"

    @property
    def place(self) -> tuple[str | int, ...]:
        """The place of its rows in a table."""
        named = f"{self.name}, {self.aim}" if self.aim else self.name
        return self.experiment, ["", *STARTS.values()].index(self.start), named


def short(name: str) -> str:
    """Return an object's name without its number."""
    return re.sub(r"^\d+_", "", name).replace("_", " ")


def place(setting: Setting, name: str, axis: Axis) -> str:
    """Return the label on the axis of an object's start or target."""
    if axis == "gap":
        return STARTS[setting.gap]
    return "; ".join(modes(setting.distribution("target", name, f)) for f in setting.factors(name))


def colours(settings: Sequence[Setting]) -> dict[str, str]:
    """Return a colour for every method."""
    methods = list(dict.fromkeys(method for setting in settings for method in setting.methods))
    others = [method for method in methods if method not in COLOURS]
    return COLOURS | {method: OTHERS[i % len(OTHERS)] for i, method in enumerate(others)}


def _order(label: str, axis: Axis) -> tuple[Any, ...]:
    if axis == "gap":
        return (list(STARTS.values()).index(label),)
    return (label.count(","), label)


def _panels(settings: Sequence[Setting], axis: Axis) -> dict[Panel, dict[str, Setting]]:
    """Group settings by panel, then by place on the axis, where the newest is kept if there are several.

    ``settings`` are sorted by experiment, the newest of each first.
    """
    aims: dict[tuple[str, str], set[str]] = {}
    for setting in settings:
        for name in setting.objects:
            aims.setdefault((setting.experiment, name), set()).add(place(setting, name, "target"))
    panels: dict[Panel, dict[str, Setting]] = {}
    for setting in settings:
        for name in setting.objects:
            several = axis == "gap" and len(aims[setting.experiment, name]) > 1
            aim = place(setting, name, "target") if several else ""
            key = Panel(setting.experiment, "" if axis == "gap" else STARTS[setting.gap], name, aim)
            label, panel = place(setting, name, axis), panels.setdefault(key, {})
            if label in panel:
                _log.warning("experiments: %s has older settings at %s, which are left out", key.title, label)
            panel.setdefault(label, setting)
    experiments = [setting.experiment for setting in settings]
    return {
        key: dict(sorted(panel.items(), key=lambda item: _order(item[0], axis)))
        for key, panel in sorted(
            panels.items(), key=lambda item: (experiments.index(item[0].experiment), *item[0].place[1:])
        )
    }


def levels_figure(settings: Sequence[Setting], axis: Axis) -> Figure:
    """Draw a panel per object and a line per method, with 95 % intervals; matched, the upper bound, is dashed."""
    panels, colour = _panels(settings, axis), colours(settings)
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.6 * columns + 0.8, 2.6 * rows + 0.5), layout="constrained")
    handles: dict[str, Any] = {}
    for number, (key, panel) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        methods = list(dict.fromkeys(m for setting in panel.values() for m in setting.methods))
        for i, method in enumerate(methods):
            aside = APART * (i - (len(methods) - 1) / 2)
            line = _line(axes, list(panel.values()), key.name, method, aside, colour[method])
            handles.setdefault(called(method), line)
        axes.set_title(key.title, fontsize=9, color=figures.INK)
        axes.set_xticks(range(len(panel)), list(panel))
        axes.set(ylim=(0, 100), xlim=(-0.3, len(panel) - 0.7))
        axes.set_xlabel(LABELS[axis], fontsize=8, color=figures.MUTED)
        if (number - 1) % columns == 0:
            score = next(iter(panel.values())).first.score
            axes.set_ylabel(f"{score} on the test set (%)", fontsize=8)
        axes.yaxis.grid(color=figures.GRID)
        figures.style(axes)
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8, frameon=False)
    return figure


def _line(axes: Any, panel: Sequence[Setting], name: str, method: str, aside: float, colour: str) -> Any:
    """Draw the line of one method, shifted from the ticks by ``aside`` so that intervals do not hide each other.

    The line has gaps at settings without a run of the method. That of matched has a dash at every setting, so that a
    single one is visible.
    """
    found = [setting.score(method, name) if method in setting.table.detectors else None for setting in panel]
    values = 100 * np.asarray([np.nan if each is None else each.value for each in found])
    low, high = (
        100 * np.asarray([np.nan if e is None or (v := getattr(e, end)) is None else v for e in found])
        for end in ("low", "high")
    )
    spread = np.nan_to_num(np.abs(np.stack([values - low, high - values])))
    bound = method == "matched"
    return axes.errorbar(
        np.arange(len(panel)) + (0.0 if bound else aside), values, None if bound else spread,
        fmt="_--" if bound else "o-", markersize=24.0 if bound else 3.5,
        color=colour, linewidth=1.2, capsize=2,
    )  # fmt: skip


def levels_entries(settings: Sequence[Setting], axis: Axis) -> list[Entry]:
    """Return a row for every object at every setting, with a score per method in points and 95 % intervals.

    The rows' lines give the reference's score and its leads; over ``gap``, only rows of the disjoint start have one.
    """
    made = []
    for key, panel in _panels(settings, axis).items():
        for label, setting in panel.items():
            cells = {"experiment": key.experiment, "object": short(key.name)}
            cells |= {"start": key.start} if axis == "target" else {"target": key.aim} if key.aim else {}
            cells |= {LABELS[axis]: label, "seeds": setting.seeds}
            cells |= {called(method): points(setting.score(method, key.name)) for method in setting.columns}
            where = f", {key.start} start, target {label}" if key.start else ""
            where += f", target {key.aim}" if key.aim else ""
            line = f"{key.experiment}, {short(key.name)}{where}: {setting.verdict(key.name)}"
            shown = axis == "target" or setting.gap == "disjoint"
            place = (*key.place, *_order(label, axis))
            made.append(Entry(place, cells, line if shown else "", setting.commits))
    return made


@dataclass(frozen=True)
class Histogram:
    """Distributions of one factor of one object, from the reference method's runs of a setting.

    Args:
        setting: the setting.
        name: name of the object.
        factor: the learned factor.
        groups: groups of bins, numbered from 1, that look the same.
        p: initial, target and learned probabilities.
        distance: mean total variation of the initial and of the learned distribution from the target's.
    """

    setting: Setting
    name: str
    factor: str
    groups: Sequence[Sequence[int]]
    p: Mapping[str, Float[np.ndarray, "seeds _"]]
    distance: Mapping[str, Estimate]

    def short(self, which: str) -> str:
        """Return a short name of the ``initial`` or ``target`` distribution."""
        return modes(self.setting.distribution(which, self.name, self.factor))


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
    return Histogram(setting, name, factor, groups, p, distance)


def histogram_figure(all_of: Sequence[Histogram]) -> Figure:
    """Draw a panel per histogram: initial, learned (mean, smallest and largest over seeds) and target probabilities."""
    columns = min(3, len(all_of))
    rows = -(-len(all_of) // columns)
    figure = Figure(figsize=(3.7 * columns, 2.4 * rows + 0.6), layout="constrained")
    shown = {"initial": figures.METHOD_COLOURS["ns"], "learned": figures.METHOD_COLOURS["learned"],
               "target": figures.METHOD_COLOURS["matched"]}  # fmt: skip
    handles = []
    for number, each in enumerate(all_of, 1):
        axes, x = figure.add_subplot(rows, columns, number), np.arange(len(each.groups))
        handles = []
        for i, (which, colour) in enumerate(shown.items()):
            p = each.p[which]
            mean = p.mean(0)
            spread = None
            if (
                which == "learned" and len(p) > 1
            ):  # clipped, because the mean of equal numbers may round past them
                spread = np.stack([mean - p.min(0), p.max(0) - mean]).clip(min=0.0)
            bars = axes.bar(x + 0.28 * (i - 1), mean, 0.26, yerr=spread, color=colour, capsize=2,
                            error_kw={"linewidth": 0.8, "ecolor": figures.INK})  # fmt: skip
            handles.append(bars)
        labels = ["=".join(map(str, group)) for group in each.groups]
        axes.set_xticks(x, labels)
        axes.set(ylim=(0, 1))
        title = (
            f"{short(each.name)}, {each.factor}: target {each.short('target')}, from {each.short('initial')}"
        )
        axes.set_title(title, fontsize=8.5, color=figures.INK)
        axes.yaxis.grid(color=figures.GRID)
        axes.set_axisbelow(True)
        figures.style(axes)
    figure.legend(handles, list(shown), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def distance(estimate: Estimate) -> str:
    """Write a total variation with its interval."""
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.2f}"
    return f"{estimate.value:.2f} ({estimate.low:.2f} to {estimate.high:.2f})"


def histogram_entries(all_of: Sequence[Histogram]) -> list[Entry]:
    """Return a row per histogram with its total variation from the target, with 95 % intervals over seeds."""
    made = []
    for h in all_of:
        initial, learned = (distance(h.distance[which]) for which in ("initial", "learned"))
        experiment, start, aim = h.setting.experiment, h.short("initial"), h.short("target")
        cells = {
            "experiment": experiment, "object": short(h.name), "factor": h.factor, "target": aim, "start": start,
            "seeds": h.setting.seeds, "initial": initial, "learned": learned,
        }  # fmt: skip
        line = (
            f"{short(h.name)}, {h.factor} target {aim} from {start}: total variation {initial} to {learned}"
        )
        made.append(Entry((experiment, h.name, h.factor, aim, start), cells, line, h.setting.commits))
    return made
