"""report.html of a run: what was gained, what was learned, how far to trust it, what it cost, what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from matplotlib.colors import to_hex
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.detector.metrics import mean_of
from neural_sim.detector.protocol import Score
from neural_sim.documents import write_whole
from neural_sim.outer.certificate import untrusted
from neural_sim.report import figures
from neural_sim.report.bootstrap import match
from neural_sim.report.figures import Figure
from neural_sim.report.page import pictures, render
from neural_sim.report.page.pictures import Picture
from neural_sim.report.page.steps import step_rows
from neural_sim.report.page.verdict import POINTS, Gain, listed, verdict
from neural_sim.report.page.weak_bins import bin_scores, by_object, weakest
from neural_sim.report.run import Learned, RunResults
from neural_sim.report.score_table import ScoreTable
from neural_sim.types import LabelledImages

FILE = "report.html"
PER_OBJECT = {True: 6, False: 2}
"""Training images shown of an object that is biased, and of another."""
EXAMPLES = 8
"""Detections shown of a kind."""
DRAWS = 200
"""Resampled test sets of an interval."""


@dataclass(frozen=True)
class Shown:
    """Images for the page.

    Args:
        before: training images from the initial distribution, an equal number of every object in the order of labels.
        after: the same from the learned distribution, drawn with the same random numbers.
        test: the test images.
        detections: on these, of ns, learned and, where it is known, matched; empty without scores.
    """

    before: LabelledImages
    after: LabelledImages
    test: LabelledImages
    detections: Mapping[str, Sequence[Mapping[str, Tensor]]] = field(default_factory=dict)


@dataclass(frozen=True)
class PsiChart:
    """One object's distribution of a factor: the chart, and its distances from the target (empty: not known)."""

    name: str
    chart: str
    distances: Mapping[str, float]


@dataclass(frozen=True)
class FactorCharts:
    """The charts of a factor, with the colours of its bins."""

    factor: str
    colours: tuple[str, ...]
    charts: tuple[PsiChart, ...]


@dataclass(frozen=True)
class ScoreRow:
    """AP (or accuracy) of a class by detector, as fractions; None where the test set lacks the class."""

    name: str
    biased: bool
    ap: Mapping[str, float | None]


def write_run_page(results: RunResults, shown: Shown, commands: Mapping[str, str], folder: Path) -> Path:
    """Write report.html, without references to other files but links to its neighbours in ``folder``.

    ``commands`` are what to run next, by what it does.
    """
    names, scored = list(results.names), bool(shown.detections)
    aim = list(results.biased) or names
    gains = _gains(results, aim, shown) if scored else {}
    both = {which: shown.detections[which] for which in ("ns", "learned")} if scored else {}
    scores = bin_scores(names, both, shown.test, score=results.score) if scored else []
    text = render.page(
        "run.html",
        title=f"{results.experiment}: {results.method}, seed {results.seed}",
        results=results,
        verdict=verdict(gains.get("aim"), results.score),
        points=POINTS[results.score],
        others=gains.get("others"),
        lost=[gain for key, gain in gains.items() if key.startswith("lost:")],
        psi=_psi(results),
        shown=[(shown_chart(one), one) for one in results.shown],
        rows=_score_rows(results),
        curve=_curve(results, aim),
        aim=listed(aim),
        before=_training(shown.before, results),
        after=_training(shown.after, results),
        examples=_examples(shown, names, results.score) if scored else {},
        steps=step_rows(results.records, names),
        trust=untrusted(results.records),
        bins=by_object(scores),
        weak=weakest([s for s in scores if s.name in aim]),
        commands=commands,
        files=_files(folder),
    )
    path = folder / FILE
    return write_whole(path, text)


def _gains(results: RunResults, aim: Sequence[str], shown: Shown) -> dict[str, Gain]:
    """Return gains of the objects that the run is about, of all others, and of each of these that certainly lost."""
    same = results.target_known and all(one.p["initial"] == one.p["target"] for one in results.learned)
    table = score_table(shown, results.names, results.score)

    def gain(names: Sequence[str]) -> Gain:
        return Gain.of(table.of_classes(names), same)

    gains = {"aim": gain([name for name in aim if name in table.shown] or table.shown)}
    others = [name for name in table.shown if name not in aim]
    if others:
        gains["others"] = gain(others)
        each = {name: gain([name]) for name in others}
        gains |= {f"lost:{name}": g for name, g in each.items() if g.outcome == "worse"}
    return gains


def score_table(shown: Shown, names: Sequence[str], score: Score) -> ScoreTable:
    """Score ns, learned and, where it is known, matched on the test images and on resampled ones."""
    outcomes = {
        which: [[match(shown.detections[which], shown.test, label, score) for label in range(len(names))]]
        for which in ("ns", "learned", "matched")
        if which in shown.detections
    }
    return ScoreTable.of(outcomes, names, DRAWS)


def _psi(results: RunResults) -> list[FactorCharts]:
    """Return charts of what was learned, the biased objects' first; none where nothing was."""
    drawn = []
    for factor in results.factors if results.moved else ():
        learned = sorted(results.of_factor(factor), key=lambda one: one.name not in results.biased)
        panels = [PsiChart(one.name, psi_chart(one), one.distances) for one in learned]
        colours = bin_colours(factor, len(learned[0].p["learned"]))
        drawn.append(FactorCharts(factor, tuple(colours), tuple(panels)))
    return drawn


def _score_rows(results: RunResults) -> list[ScoreRow]:
    """Return scores by class, the biased ones first, and their mean last."""

    def row(name: str, values: Mapping[str, float]) -> ScoreRow:
        known = {which: value if value == value else None for which, value in values.items()}
        return ScoreRow(name, name in results.biased, known)

    order = sorted(results.names, key=lambda name: name not in results.biased)
    rows = [row(name, {w: s["per_class"][name] for w, s in results.ap.items()}) for name in order]
    return [*rows, row("mean", {w: mean_of(s) for w, s in results.ap.items()})] if results.ap else []


def _curve(results: RunResults, aim: Sequence[str]) -> str | None:
    if len(results.curve) < 2:
        return None
    bounds = {}
    if "matched" in results.ap:
        per_class = results.ap["matched"]["per_class"]
        bounds = {"matched": sum(per_class[name] for name in aim) / len(aim)}
    return curve_chart(results.curve, list(aim), bounds, results.score)


def bin_colours(factor: str, bins: int) -> list[str]:
    """Return the colours of a factor's bins in these charts, for a legend."""
    return [to_hex(colour) for colour in figures.bin_colours(factor, bins)]


def shown_chart(one: FactorEstimate) -> str:
    """Draw what the target shows of one object and factor, with psi's bars next to it."""
    figure = Figure(figsize=(3.4, 1.9), layout="constrained")
    figures.shown_panel(figure.add_subplot(), one)
    return render.data_uri(figure)


def psi_chart(learned: Learned) -> str:
    """Draw one object's probabilities over the iterations, with the target's next to them."""
    figure = Figure(figsize=(3.4, 2.1), layout="constrained")
    figures.psi_panel(figure.add_subplot(), learned)
    return render.data_uri(figure)


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
    return render.data_uri(figure)


def _training(images: LabelledImages, results: RunResults) -> list[Picture]:
    """Return the first few images of every object."""
    each = len(images) // len(results.names)
    rows = []
    for label, name in enumerate(results.names):
        count = min(each, PER_OBJECT[name in results.biased or not results.biased])
        rows += range(label * each, label * each + count)
    return pictures.labelled(images, rows, results.names)


def _examples(shown: Shown, names: Sequence[str], score: Score) -> dict[str, list[Picture]]:
    """Return test images by what the training on the learned distribution changed, a few of each kind."""
    test, kinds = shown.test, {"won": [], "lost": [], "still wrong": [], "right": []}
    for row in range(len(test)):
        own = test.labels[row] >= 0
        truth = test.boxes[row][own], test.labels[row][own]
        before, after = (
            pictures.right(shown.detections[which][row], *truth, score) for which in ("ns", "learned")
        )
        kind = ("right" if before else "won") if after else ("lost" if before else "still wrong")
        kinds[kind].append(row)
    found = {}
    for kind, rows in kinds.items():
        chosen = [rows[i] for i in torch.linspace(0, len(rows) - 1, min(EXAMPLES, len(rows))).round().long()]
        title = f"{kind} ({len(rows)} of {len(test)})"
        found[title] = pictures.detected(test, chosen, shown.detections["learned"], names)
    return found


def _files(folder: Path) -> list[str]:
    """Return the files of the run that a reader may open next."""
    wanted = ("results.json", "detections.json", "training_set/annotations.json", "model.json", "model.onnx")
    return [name for name in wanted if (folder / name).exists()]
