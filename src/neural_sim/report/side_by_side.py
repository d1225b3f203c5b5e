"""AP of detectors trained on images of several sources: tables and figures of nerf_vs_mesh and sfm_vs_nerf."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from neural_sim.report import figures, tracking
from neural_sim.report.bootstrap import Outcomes, class_scores, mean_of_known
from neural_sim.report.compare import plain, points
from neural_sim.report.figures import CLASS_COLOURS, GRID, INK
from neural_sim.report.intervals import Estimate, over_seeds_and_images
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class SideBySide:
    """By test set: ``ap`` of every source, the mean over classes and seeds; ``ahead``, by how much the first source
    exceeds each other one; ``per_class``, each source's AP by class, the mean over seeds. ``images`` is the number of
    test images, of all seeds together.
    """

    sources: tuple[str, ...]
    seeds: tuple[int, ...]
    images: Mapping[str, int]
    ap: Mapping[str, Mapping[str, Estimate]]
    ahead: Mapping[str, Mapping[str, Estimate]]
    per_class: Mapping[str, Mapping[str, Mapping[str, float]]]


def side_by_side(
    matches: Mapping[str, Sequence[Sequence[Sequence[Outcomes]]]],
    sources: Sequence[str],
    classes: Sequence[str],
    seeds: Sequence[int],
    images: Mapping[str, int],
    draws: int,
) -> SideBySide:
    """From ``matches`` [seed][source][class] by test set, with ``draws`` bootstrap draws over test images.

    All sources of a seed are scored on the same test images, so that differences are paired.
    """
    ap, ahead, per_class = {}, {}, {}
    for kind, rows in matches.items():
        by_class, resampled = class_scores(rows, draws)
        point, spread = mean_of_known(by_class), mean_of_known(resampled)
        ap[kind] = {
            s: over_seeds_and_images(point[:, i], spread[..., i]).as_fraction for i, s in enumerate(sources)
        }
        ahead[kind] = {
            s: over_seeds_and_images(point[:, 0] - point[:, i], spread[..., 0] - spread[..., i])
            for i, s in enumerate(sources)
            if i
        }
        means = by_class.mean(0)
        per_class[kind] = {
            source: dict(zip(classes, means[i].tolist(), strict=True)) for i, source in enumerate(sources)
        }
    return SideBySide(tuple(sources), tuple(seeds), images, ap, ahead, per_class)


def table(found: SideBySide, heading: str) -> str:
    """Markdown."""
    first, *others = found.sources
    count = len(found.seeds)
    over = "seeds and test images" if count > 1 else "test images"
    lines = [
        f"{heading} AP (0.50 to 0.95) in points, mean of all classes, with 95 % intervals over {over}; "
        f"seed{'s' if count > 1 else ''} {', '.join(map(str, found.seeds))}."
        + (" Differences in bold exceed the spread." if count > 1 else ""),
        "",
        "| test images | number | "
        + " | ".join(found.sources)
        + "".join(f" | {first} ahead of {other} by" for other in others)
        + " |",
        "|---|---|" + "---|" * (len(found.sources) + len(others)),
    ]
    for kind, row in found.ap.items():
        cells = [points(row[source]) for source in found.sources]
        cells += [points(found.ahead[kind][other], sure=count > 1) for other in others]
        lines.append(f"| {kind} | {found.images[kind]} | " + " | ".join(cells) + " |")
    lines += ["", "| test images, class | " + " | ".join(found.sources) + " |"]
    lines += ["|---|" + "---|" * len(found.sources)]
    for kind, by_source in found.per_class.items():
        for name in by_source[first]:
            cells = [f"{100 * by_source[source][name]:.1f}" for source in found.sources]
            lines.append(f"| {kind}, {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def ap_figure(found: SideBySide, title: str) -> Figure:
    """A group of bars for each test set, one bar a source, with the intervals."""
    kinds = list(found.ap)
    figure = Figure(figsize=(1.9 * len(kinds) + 3.2, 3.2), layout="constrained")
    axes = figure.add_subplot()
    width = 0.8 / len(found.sources)
    for column, source in enumerate(found.sources):
        values = [found.ap[kind][source] for kind in kinds]
        x = np.arange(len(kinds)) + (column - (len(found.sources) - 1) / 2) * width
        height = [100 * value.value for value in values]
        reach = [[100 * (v.value - (v.value if v.low is None else v.low)) for v in values],
                 [100 * ((v.value if v.high is None else v.high) - v.value) for v in values]]  # fmt: skip
        axes.bar(x, height, 0.92 * width, color=CLASS_COLOURS[column], label=source)
        axes.errorbar(x, height, np.maximum(reach, 0.0), fmt="none", ecolor=INK, elinewidth=1, capsize=3)
        for at, value, above in zip(x, height, reach[1], strict=True):
            axes.text(at, value + max(above, 0.0) + 1.5, f"{value:.1f}", ha="center", fontsize=8, color=INK)
    axes.set_xticks(range(len(kinds)), kinds)
    axes.set(ylabel="AP on the test images (%)", ylim=(0, 105))
    axes.set_title(title, color=INK, fontsize=10)
    axes.yaxis.grid(color=GRID)
    axes.set_axisbelow(True)
    figures.style(axes)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, title="trained on")
    return figure


def report_side_by_side(
    found: SideBySide,
    shown: LabelledImages,
    classes: Sequence[str],
    heading: str,
    name: str,
    config: Mapping[str, Any],
    uri: str,
    folder: Path,
    begun: float,
    extra: Mapping[str, Any] | None = None,
    text: str = "",
    more_figures: Mapping[str, Figure] | None = None,
) -> tracking.Run:
    """``<name>.md``, ``<name>.json`` and figures in ``folder``, and a run in MLflow that began at ``begun`` (seconds
    since 1970). ``shown`` are training images of every source, source by source; ``extra``, ``text`` and
    ``more_figures`` are added to the document, the table and the figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join([part for part in (table(found, heading), text) if part])
    (folder / f"{name}.md").write_text(text + "\n")
    document = {**dataclasses.asdict(found), **(extra or {})}
    (folder / f"{name}.json").write_text(json.dumps(plain(document), indent=1, allow_nan=False))
    figures.save(ap_figure(found, heading), folder / "figures" / "ap.png")
    for called, drawn in (more_figures or {}).items():
        figures.save(drawn, folder / "figures" / f"{called}.png")
    rows = "; ".join(f"row {i + 1}: {source}" for i, source in enumerate(found.sources))
    grid = figures.image_grid(
        shown, classes, len(shown) // len(found.sources), title=f"Training images, {rows}"
    )
    figures.save(grid, folder / "figures" / "training_images.png")
    print(text)
    metrics = {
        f"{kind}/{source}/ap": estimate.value
        for kind, row in found.ap.items()
        for source, estimate in row.items()
    }
    seed = str(config["seed"])
    return tracking.log_run(
        uri, name, f"seed {seed}", {"seed": seed}, tracking.flatten(config), metrics, {}, folder, begun
    )
