"""report.html of a run: its gain, the learned psi, how far to trust it, its cost, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neural_sim.detector.metrics import mean_of, mean_over
from neural_sim.detector.protocol import Score
from neural_sim.documents import write_whole
from neural_sim.outer.certificate import untrusted
from neural_sim.report import figures
from neural_sim.report.figures import Figure, Thumbnails
from neural_sim.report.page import pictures, render
from neural_sim.report.page.pictures import Picture
from neural_sim.report.page.psi import learned_psi, shown_chart, step_rows
from neural_sim.report.page.verdict import POINTS, Gain, listed, verdict
from neural_sim.report.page.weak_bins import BinScore, bin_scores, forgotten, weaknesses
from neural_sim.report.run import CALLED, RunResults
from neural_sim.report.score_table import ScoreTable, match
from neural_sim.types import LabelledImages

FILE = "report.html"
PER_OBJECT = {True: 6, False: 2}
"""Number of training images shown of an object, by whether it is biased."""
EXAMPLES = 8
"""Number of images with detections shown of each kind."""
DRAWS = 200
"""Number of resampled test sets for an interval."""
FEWEST = 3
"""Smallest number of scored iterations for a curve; a start and an end alone are in the table."""
FILES = {
    "results.json": "all numbers",
    "psi.csv": "the learned distribution as a table, for any renderer",
    "objects.html": "whether the fields show their objects",
    "detections.json": "detections on the test images",
    "training_set/annotations.json": "training images with boxes and poses",
    "model.safetensors": "the detector",
    "model.onnx": "the detector for onnxruntime",
    "figures/strip.png": "the run in one picture",
    "figures/ap.png": "scores",
    "main.log": "what the run said",
    ".hydra/config.yaml": "all settings",
}
"""Files next to the page that a reader may open."""


@dataclass(frozen=True)
class Shown:
    """Images for the page.

    Args:
        before: training images from the initial distribution, an equal number of every object in the order of labels.
        after: the same from the learned distribution, drawn with the same random numbers.
        test: the test images.
        detections: detections on the test images by ns, learned and, if known, matched; empty without scores.
        bins: pictures of every bin.
    """

    before: LabelledImages
    after: LabelledImages
    test: LabelledImages
    detections: Mapping[str, Sequence[Mapping[str, Tensor]]] = field(default_factory=dict)
    bins: Thumbnails = field(default_factory=dict)


@dataclass(frozen=True)
class ScoreRow:
    """AP (or accuracy) of a class by detector, as fractions; None if the test set lacks the class."""

    name: str
    biased: bool
    ap: Mapping[str, float | None]


@dataclass(frozen=True)
class RunPage:
    """The page of a run, and its first sentence."""

    results: RunResults
    shown: Shown

    @cached_property
    def gains(self) -> dict[str, Gain]:
        """Gains of the objects that the run is about, of all others, and of each other object that lost significantly.

        Empty if there are no scores.
        """
        results = self.results
        if not self.shown.detections:
            return {}
        same = results.target_known and all(one.p["initial"] == one.p["target"] for one in results.learned)
        table = score_table(self.shown, results.names, results.score)
        if not table.shown:
            return {}

        def gain(names: Sequence[str]) -> Gain:
            return Gain.of(table.of_classes(names), same)

        gains = {"aim": gain([name for name in self.aim if name in table.shown] or table.shown)}
        others = [name for name in table.shown if name not in self.aim]
        if others:
            gains["others"] = gain(others)
            each = {name: gain([name]) for name in others}
            gains |= {f"lost:{name}": g for name, g in each.items() if g.outcome == "worse"}
        return gains

    @property
    def aim(self) -> list[str]:
        """The objects that the run is about."""
        return list(self.results.biased) or list(self.results.names)

    @property
    def headline(self) -> str:
        """A sentence that says whether the run worked."""
        return verdict(self.gains.get("aim"), self.results.score, images=self.results.made.shows)

    @cached_property
    def bins(self) -> list[BinScore]:
        """Scores by bin of the test images."""
        compared = {w: d for w, d in self.shown.detections.items() if w in ("ns", "learned", "matched")}
        names, score = list(self.results.names), self.results.score
        return bin_scores(names, compared, self.shown.test, score=score) if compared else []

    def write(self, commands: Mapping[str, str], folder: Path) -> Path:
        """Write report.html, with its pictures embedded and links only to files in ``folder``.

        ``commands`` are commands to run next, by what they do.
        """
        results, shown = self.results, self.shown
        names = list(results.names)
        psi = learned_psi(results, shown.bins, self.bins)
        tiles = {
            (one.name, tile.number): tile
            for own in psi.values()
            for one in own
            for tile in one.tiles
            if tile.score
        }
        text = render.page(
            "run.html",
            title=f"{results.experiment}: {results.method}, seed {results.seed}",
            results=results,
            made=results.made,
            called=CALLED,
            verdict=self.headline,
            points=POINTS[results.score],
            others=self.gains.get("others"),
            lost=[gain for key, gain in self.gains.items() if key.startswith("lost:")],
            strip=render.png_uri(folder / "figures" / "strip.png"),
            psi=psi,
            tiles=tiles,
            shown=[(shown_chart(one), one) for one in results.shown],
            rows=_score_rows(results),
            curve=_curve(results, self.aim),
            aim=listed(self.aim),
            before=_training(shown.before, results),
            after=_training(shown.after, results),
            examples=_examples(shown, names, results.score) if shown.detections else {},
            steps=step_rows(results.records, names),
            trust=untrusted(results.records),
            bins=bool(self.bins),
            weak=weaknesses(self.bins),
            forgotten=forgotten(self.bins, names, shown.detections, shown.test, results.score),
            commands=commands,
            files={name: what for name, what in FILES.items() if (folder / name).exists()},
        )
        return write_whole(folder / FILE, text)


def score_table(shown: Shown, names: Sequence[str], score: Score) -> ScoreTable:
    """Score ns, learned and, if known, matched on the test images and on resampled ones."""
    outcomes = {
        which: [[match(shown.detections[which], shown.test, label, score) for label in range(len(names))]]
        for which in ("ns", "learned", "matched")
        if which in shown.detections
    }
    return ScoreTable.of(outcomes, names, DRAWS)


def _score_rows(results: RunResults) -> list[ScoreRow]:
    """Return scores by class, the biased ones first, and their mean last."""

    def row(name: str, values: Mapping[str, float]) -> ScoreRow:
        known = {which: value if value == value else None for which, value in values.items()}
        return ScoreRow(name, name in results.biased, known)

    order = sorted(results.names, key=lambda name: name not in results.biased)
    rows = [row(name, {w: s["per_class"][name] for w, s in results.ap.items()}) for name in order]
    return [*rows, row("mean", {w: mean_of(s) for w, s in results.ap.items()})] if results.ap else []


def _curve(results: RunResults, aim: Sequence[str]) -> str | None:
    if len(results.curve) < FEWEST:
        return None
    bounds = {}
    if "matched" in results.ap:
        bounds = {CALLED["matched"]: mean_over(results.ap["matched"], aim)}
    return curve_chart(results.curve, list(aim), bounds, results.score)


def curve_chart(
    curve: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    bounds: Mapping[str, float],
    score: Score = "AP",
) -> str:
    """Draw the mean score of some classes against the method's seconds.

    Args:
        curve: costs and scores (as fractions) of the scored iterations.
        names: names of the classes; those without a score are left out of the mean.
        bounds: scores of other detectors by name, drawn as lines.
        score: the kind of score.
    """
    figure = Figure(figsize=(6.2, 2.9), layout="constrained")
    axes = figure.add_subplot()
    seconds = [point["seconds"] for point in curve]
    ap = [100.0 * mean_over(point["ap"], names) for point in curve]
    axes.plot(seconds, ap, "o-", color=figures.METHOD_COLOURS["learned"], linewidth=1.6, markersize=5)
    for place in _apart(seconds):
        axes.annotate(f"{ap[place]:.1f}", (seconds[place], ap[place]), textcoords="offset points", xytext=(0, 6),
                      ha="center", fontsize=8, color=figures.INK)  # fmt: skip
    for name, value in bounds.items():
        axes.axhline(100.0 * value, color=figures.MUTED, linestyle="--", linewidth=1, label=name)
    if bounds:  # outside, where it covers no point
        figure.legend(loc="outside upper right", fontsize=8, frameon=False, labelcolor=figures.MUTED)
    axes.set(xlabel="seconds of the method, its warm start included", ylabel=f"{score} (%)", xlim=(0, None))
    axes.margins(x=0.06, y=0.2)
    axes.grid(color=figures.GRID)
    figures.style(axes)
    return render.data_uri(figure)


def _apart(seconds: Sequence[float], least: float = 0.08) -> list[int]:
    """Return the points whose labels do not overlap: from the last backwards, each that is far enough from the next."""
    width, kept = least * (seconds[-1] or 1.0), [len(seconds) - 1]
    for place in range(len(seconds) - 2, -1, -1):
        if seconds[kept[-1]] - seconds[place] >= width:
            kept.append(place)
    return kept


def _training(images: LabelledImages, results: RunResults) -> list[Picture]:
    """Return the first few images of every object."""
    each = len(images) // len(results.names)
    rows = []
    for label, name in enumerate(results.names):
        count = min(each, PER_OBJECT[name in results.biased or not results.biased])
        rows += range(label * each, label * each + count)
    return pictures.labelled(images, rows, results.names)


def _examples(shown: Shown, names: Sequence[str], score: Score) -> dict[str, list[Picture]]:
    """Return a few test images of each kind, by how training on the learned distribution changed their detections."""
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
