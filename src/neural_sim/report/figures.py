"""The figures of a run, and the style that all figures share."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence, Sized
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import MOVING, FactorEstimate
from neural_sim.detector.metrics import mean_of
from neural_sim.detector.protocol import Score
from neural_sim.parameter.distributions import merged
from neural_sim.report.run import CALLED, Learned, RunResults
from neural_sim.types import LabelledImages

matplotlib.use("Agg")

INK, MUTED, GRID = "#22262b", "#6b727b", "#e4e7ea"
Thumbnails = Mapping[str, Mapping[str, UInt8[Tensor, "bins h w 3"]]]
"""Pictures of an object from the middle of every bin, by object and factor."""
# Okabe and Ito's palette (Color Universal Design, 2008), which readers with any colour vision can tell apart.
METHOD_COLOURS = {
    "ns": "#b0b7bf", "learned": "#0072b2", "matched": "#009e73", "synthetic_only": "#56b4e9", "real_only": "#e69f00",
    "views_only": "#cc79a7",
}  # fmt: skip
CLASS_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7a5cc4", "#8c6d1f")


def style(axes: Any) -> None:
    """Give axes the frame that all figures share."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelsize=8)


def save(figure: Figure, path: Path) -> Path:
    """Write a PNG and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, facecolor="white")
    return path


def picture(axes: Any, pixels: np.ndarray, **where: Any) -> None:
    """Show an image without ticks and frame."""
    axes.imshow(pixels, **where)
    axes.set(xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_visible(False)


def titled(figure: Figure, text: str, fontsize: float = 11.0) -> None:
    """Write a title above a figure, in as many lines as its width asks for."""
    letters = int(72.0 * figure.get_figwidth() / (0.6 * fontsize))
    # Without a layout, the distance from the edge is in inches, since 2 % of a tall figure reach into its images.
    y = None if figure.get_layout_engine() else 1.0 - 0.08 / figure.get_figheight()
    figure.suptitle(textwrap.fill(text, max(letters, 8)), y=y, color=INK, fontsize=fontsize)


def psi_figure(learned: Sequence[Learned], title: str) -> Figure:
    """Draw one panel per object: the probabilities of a factor's bins by iteration, next to the target's."""
    columns = min(3, len(learned))
    rows = -(-len(learned) // columns)
    figure = Figure(figsize=(3.7 * columns, 2.5 * rows + 0.9), layout="constrained")
    factor, bins = learned[0].factor, len(learned[0].history[0])
    colours = bin_colours(factor, bins)
    figure.suptitle(title, color=INK, fontsize=11)
    for place, one in enumerate(learned, 1):
        axes = figure.add_subplot(rows, columns, place)
        psi_panel(axes, one)
        axes.set_title(_titled(one), fontsize=9)
    handles = [Rectangle((0, 0), 1, 1, color=colours[b]) for b in range(bins)]
    figure.legend(
        handles, [str(b + 1) for b in range(bins)], loc="outside lower center", ncols=min(bins, 16),
        title=f"{factor} bin (x: outer iteration, y: probability)", fontsize=8, title_fontsize=8, frameon=False,
    )  # fmt: skip
    return figure


def bin_colours(factor: str, bins: int) -> Any:
    """Return one colour per bin; those of poses are cyclic, as the angle is."""
    return matplotlib.colormaps["twilight_shifted" if factor == "pose" else "viridis"](
        np.linspace(0.08, 0.92, bins)
    )


def psi_panel(axes: Any, learned: Learned) -> None:
    """Draw one object's probabilities, stacked, by iteration, and its target's next to them.

    Bins that look the same are stacked as one, in the colour of the first.
    """
    groups = learned.groups
    colours = bin_colours(learned.factor, len(learned.history[0]))
    p = merged(torch.tensor(learned.history), groups).numpy()
    shades = [colours[group[0] - 1] for group in groups]
    steps = np.arange(len(p))
    width = max(1.0, 0.12 * len(p))
    axes.stackplot(steps, p.T, colors=shades, linewidth=0)
    ticks = range(0, len(p), max(1, -(-(len(p) - 1) // 6)))
    style(axes)
    axes.set(xlim=(0, max(1, len(p) - 1)), ylim=(0, 1), xticks=ticks)
    if "target" not in learned.p:
        return
    wanted, bottom = merged(torch.tensor(learned.p["target"]), groups).numpy(), 0.0
    for group, mass, shade in zip(groups, wanted, shades, strict=True):
        axes.bar(len(p) - 1 + 1.1 * width, mass, width, bottom=bottom, color=shade, linewidth=0)
        if mass > 0.25:
            axes.text(len(p) - 1 + 1.1 * width, bottom + mass / 2, "=".join(map(str, group)), ha="center",
                      va="center", color="white", fontsize=8)  # fmt: skip
        bottom += mass
    axes.set_xlim(0, len(p) - 1 + 1.8 * width)
    axes.set_xticks([*ticks, len(p) - 1 + 1.1 * width], [*map(str, ticks), "target"])


def shown_panel(axes: Any, one: FactorEstimate) -> None:
    """Draw the estimate from the target's boxes with its intervals, and psi, by bin.

    Bins that look the same are drawn as one.
    """
    groups = one.groups
    start, p, low, high = (
        merged(torch.tensor(values), groups).numpy() for values in (one.start, one.p, one.low, one.high)
    )
    at = np.arange(len(groups))
    axes.bar(at - 0.2, start, 0.38, color=MUTED, alpha=0.6, label="psi")
    if one.finding != "too few boxes":
        errors = np.stack([p - low, high - p]).clip(0.0)
        strong = 1.0 if one.finding in MOVING else 0.4
        axes.bar(at + 0.2, p, 0.38, yerr=errors, color=METHOD_COLOURS["learned"], ecolor=INK, capsize=2,
                 label="target", alpha=strong)  # fmt: skip
    style(axes)
    axes.set_xticks(at, ["=".join(map(str, group)) for group in groups], fontsize=7)
    axes.set(ylim=(min(0.0, float(low.min())), max(1.0, float(high.max())) if one.lights else 1))
    axes.legend(fontsize=7, frameon=False)


def _titled(learned: Learned) -> str:
    """Write the object's name, and which of its bins are treated as one."""
    same = ["=".join(map(str, group)) for group in learned.groups if len(group) > 1]
    return f"{learned.name} ({', '.join(same)})" if same else learned.name


def ap_figure(
    ap: Mapping[str, Mapping], class_names: Sequence[str], emphasised: Sequence[str], score: Score = "AP"
) -> Figure:
    """Draw AP (or accuracy) of every class for each training distribution; biased classes come first, in bold."""
    order = [n for n in class_names if n in emphasised] + [n for n in class_names if n not in emphasised]
    labels = [*order, "mean"]
    figure = Figure(figsize=(1.1 * len(labels) + 1.6, 3.2), layout="constrained")
    axes = figure.add_subplot()
    width = 0.8 / max(1, len(ap))
    for i, (method, scores) in enumerate(ap.items()):
        values = [100 * scores["per_class"].get(n, float("nan")) for n in order] + [100 * mean_of(scores)]
        x = np.arange(len(labels)) + (i - (len(ap) - 1) / 2) * width
        axes.bar(x, values, 0.92 * width, color=METHOD_COLOURS.get(method, MUTED),
                 label=CALLED.get(method, method))  # fmt: skip
        for at, value in zip(x, values, strict=True):
            if np.isfinite(value):
                axes.text(at, value + 1, f"{value:.0f}", ha="center", fontsize=7, color=INK)
    axes.set_xticks(range(len(labels)), labels)
    for tick, name in zip(axes.get_xticklabels(), labels, strict=True):
        tick.set_fontweight("bold" if name in emphasised else "normal")
    axes.set(ylabel=f"{score} on the test set (%)", ylim=(0, 105))
    axes.yaxis.grid(color=GRID)
    axes.set_axisbelow(True)
    style(axes)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, title="trained on")
    return figure


def image_grid(
    images: LabelledImages,
    class_names: Sequence[str],
    columns: int = 8,
    predictions: Sequence[Mapping[str, torch.Tensor]] | None = None,
    title: str = "",
) -> Figure:
    """Draw images with their boxes (solid), or with the best prediction (solid) over the ground truth (dashed).

    A caption names one object, and how many more there are. All images share one canvas: one axes per image would take
    a hundred times as long to lay out.
    """
    count, height, width = len(images), *images.images.shape[-2:]
    columns = max(1, min(columns, count))
    rows, gap = max(1, -(-count // columns)), round(0.18 * height)
    canvas = np.ones((rows * (height + gap), columns * (width + gap), 3), dtype=np.float32)
    side = 1.35 * (height + gap) / (width + gap)  # inches of a row; a column has 1.35
    figure = Figure(figsize=(max(1.35 * columns, 5.0), side * rows + 0.4))
    axes = figure.add_axes((0.01, 0.0, 0.98, 1.0 - 0.4 / (side * rows + 0.4)))
    for i in range(count):
        top, left = i // columns * (height + gap) + gap, i % columns * (width + gap)
        canvas[top : top + height, left : left + width] = (
            images.images[i].permute(1, 2, 0).clamp(0, 1).cpu().numpy()
        )
        shown = []
        for box, label in zip(images.boxes[i].tolist(), images.labels[i].tolist(), strict=True):
            if label >= 0:
                _box(axes, box, (left, top), label, dashed=predictions is not None)
                shown.append(class_names[label])
        caption = shown[0] if shown else "no box"
        if len(shown) > 1:
            caption += f" +{len(shown) - 1}"
        if predictions is not None:
            caption = _best_prediction(axes, predictions[i], (left, top), class_names)
        axes.text(left + width / 2, top - 2, caption, fontsize=6.5, color=MUTED, ha="center")
    axes.imshow(canvas)
    axes.set_axis_off()
    figure.suptitle(title, color=INK, fontsize=11)
    return figure


STRIP = {"the target": 2, "rendered at first": 3, "rendered now": 3}
"""Number of images of each object in each part of the strip."""


def strip_figure(
    results: RunResults, target: LabelledImages, before: LabelledImages, after: LabelledImages, rows: int = 2
) -> Figure:
    """Draw a run at a glance: target images, training images before and after, and AP, for a few objects.

    Args:
        results: the run's results.
        target: the test images.
        before: training images from the initial distribution, an equal number of every object in the order of labels.
        after: the same from the learned distribution.
        rows: largest number of objects; those whose initial distribution is not the target's come first.
    """
    height, width = target.images.shape[-2:]
    head, gap, inch = round(0.2 * height), round(0.25 * width), width  # an image is an inch wide
    chosen = _first(results, rows)
    across = sum(STRIP.values()) * width + len(STRIP) * gap + 2 * inch  # two inches of text
    canvas = np.ones((head + len(chosen) * height, across, 3), dtype=np.float32)
    figure = Figure(figsize=(across / inch, len(canvas) / inch))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    left = 0
    for (part, count), images in zip(STRIP.items(), (target, before, after), strict=True):
        axes.text(left, 0.5 * head, part, fontsize=9, color=MUTED, va="center")
        for row, name in enumerate(chosen):
            top = head + row * height
            showing = (images.labels == results.names.index(name)).any(1).nonzero()[:, 0]
            for column, index in enumerate(showing[spread(showing, count)].tolist()):
                place = left + column * width
                pixels = images.images[index].permute(1, 2, 0).clamp(0, 1).cpu().numpy()
                canvas[top : top + height - 2, place : place + width - 2] = pixels[:-2, :-2]
        left += count * width + gap
    for row, name in enumerate(chosen):
        middle = head + (row + 0.5) * height
        axes.text(left, middle, _gained(results, name), fontsize=9, color=INK, va="center", linespacing=1.5)
    axes.imshow(canvas)
    axes.set_axis_off()
    return figure


def _gained(results: RunResults, name: str) -> str:
    """Write an object's score before, after, and with the target's distribution."""
    values = {
        CALLED[which]: 100 * results.ap[which]["per_class"].get(name, float("nan"))
        for which in ("ns", "learned", "matched")
        if which in results.ap
    }
    if any(math.isnan(value) for value in values.values()):
        return f"{name}: not in the\ntest images"
    return "\n".join([f"{name}: {results.score}", *(f"{value:.0f} {said}" for said, value in values.items())])


def bins_figure(results: RunResults, bins: Thumbnails, factor: str, rows: int = 2) -> Figure:
    """Draw the bins of a factor as pictures of a few objects, with their shares of images before and after.

    Args:
        results: the run's results.
        bins: the pictures.
        factor: the factor.
        rows: largest number of objects, see ``strip_figure``.
    """
    chosen = [one for name in _first(results, rows) for one in results.of_factor(factor) if one.name == name]
    columns = len(chosen[0].p["learned"])
    figure = Figure(figsize=(1.05 * columns + 0.3, 1.5 * len(chosen)), layout="constrained")
    panels = figure.subplots(len(chosen), columns, squeeze=False)
    for row, one in enumerate(chosen):
        for number in range(columns):
            axes = panels[row, number]
            axes.imshow(bins[one.name][factor][number].numpy())
            axes.set(xticks=[], yticks=[])
            before, after = (100 * one.p[which][number] for which in ("initial", "learned"))
            axes.set_xlabel(f"bin {number + 1}\n{before:.0f} → {after:.0f} %", fontsize=8, color=INK)
            for side in axes.spines.values():
                side.set_color(METHOD_COLOURS["learned"] if after > 100 / columns else GRID)
        panels[row, 0].set_ylabel(one.name, fontsize=9, color=INK)
    return figure


def _first(results: RunResults, count: int) -> list[str]:
    """Return the first ``count`` objects; those whose initial distribution is not the target's come first."""
    return [*results.biased, *(name for name in results.names if name not in results.biased)][:count]


def _best_prediction(
    axes: Any, prediction: Mapping[str, torch.Tensor], origin: tuple[int, int], class_names: Sequence[str]
) -> str:
    if not len(prediction["scores"]):
        return "no detection"
    best = int(prediction["scores"].argmax())
    label = int(prediction["labels"][best])
    _box(axes, prediction["boxes"][best].tolist(), origin, label, dashed=False)
    return f"{class_names[label]} {float(prediction['scores'][best]):.2f}"


def _box(axes: Any, box: Sequence[float], origin: tuple[int, int], label: int, dashed: bool) -> None:
    x0, y0, x1, y1 = box
    left, top = origin
    colour = "white" if dashed else CLASS_COLOURS[label % len(CLASS_COLOURS)]
    width, line = (0.9, "--") if dashed else (1.4, "-")
    corner = (left + x0 - 0.5, top + y0 - 0.5)
    axes.add_patch(
        Rectangle(corner, x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=width, linestyle=line)
    )


def write_figures(
    results: RunResults,
    drawn: LabelledImages,
    test: LabelledImages,
    detections: Sequence[Mapping[str, torch.Tensor]],
    folder: Path,
    before_and_after: tuple[LabelledImages, LabelledImages] | None = None,
    bins: Thumbnails | None = None,
) -> list[Path]:
    """Write a run's figures as PNG files.

    Args:
        results: the run's results.
        drawn: training images of the learned distribution.
        test: the test images.
        detections: detections on the test images by the detector trained on the learned distribution; may be empty.
        folder: where the files go.
        before_and_after: a few training images of every object, see ``strip_figure``; None omits that figure.
        bins: pictures of every bin; None omits that figure.
    """
    made: dict[str, Figure] = {}
    if before_and_after is not None and results.ap:
        made["strip"] = strip_figure(results, test, *before_and_after)
    if bins:
        for factor in next(iter(bins.values())):
            made[f"bins_{factor}"] = bins_figure(results, bins, factor)
    names = list(results.names)
    for factor in results.factors if results.moved else ():
        title = f"{results.experiment}: learned {factor}, {results.method}, seed {results.seed}"
        made[f"psi_{factor}"] = psi_figure(results.of_factor(factor), title)
    if results.ap:
        made["ap"] = ap_figure(results.ap, names, results.biased, results.score)
    title = "Training images drawn from the learned distribution"
    made["training_images"] = image_grid(drawn.select(spread(drawn, 32)), names, title=title)
    if detections:
        chosen = spread(test, 32)
        found = [detections[int(i)] for i in chosen]
        title = "Detections on the test set (dashed: truth)"
        made["detections"] = image_grid(test.select(chosen), names, predictions=found, title=title)
    return [save(figure, folder / f"{name}.png") for name, figure in made.items()]


def spread(images: Sized, count: int) -> torch.Tensor:
    """Return indices of up to ``count`` images, evenly spread over all."""
    return torch.linspace(0, len(images) - 1, min(count, len(images))).round().long()
