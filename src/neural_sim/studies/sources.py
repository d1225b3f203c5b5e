"""AP of detectors that were trained on images from different sources, for nerf_vs_mesh and sfm_vs_nerf."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from neural_sim.documents import markdown_table
from neural_sim.report import figures
from neural_sim.report.figures import CLASS_COLOURS, GRID, INK
from neural_sim.report.intervals import Estimate, points
from neural_sim.report.score_table import Outcomes, ScoreTable, match
from neural_sim.report.tracking import Run
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.tasks.context import Context
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class SideBySide:
    """Scores of the detectors trained on each source, by test set.

    Attributes:
        sources: names of the sources of training images.
        seeds: seeds of the detectors.
        images: number of test images, over all seeds.
        ap: AP of each source, the mean over classes and seeds.
        ahead: lead of the first source over each other one.
        per_class: AP of each source by class, the mean over seeds.
    """

    sources: tuple[str, ...]
    seeds: tuple[int, ...]
    images: Mapping[str, int]
    ap: Mapping[str, Mapping[str, Estimate]]
    ahead: Mapping[str, Mapping[str, Estimate]]
    per_class: Mapping[str, Mapping[str, Mapping[str, float]]]

    @staticmethod
    def of(tables: Mapping[str, ScoreTable], seeds: Sequence[int], images: Mapping[str, int]) -> SideBySide:
        """Summarise the score table of every test set."""
        first, *others = sources = next(iter(tables.values())).detectors
        return SideBySide(
            sources,
            tuple(seeds),
            images,
            {kind: {source: table.mean(source) for source in sources} for kind, table in tables.items()},
            {kind: {other: table.ahead(first, other) for other in others} for kind, table in tables.items()},
            {kind: {source: table.by_class(source) for source in sources} for kind, table in tables.items()},
        )


def graphs_of_seeds(context: Context, seeds: int) -> list[Graph]:
    """Return the stages of the experiment for the run's seed and the following ones.

    Raises:
        ValueError: the task is not detection.
    """
    x = context.experiment
    x.check_boxes("a comparison of sources of images")
    return [Graph(replace(x, run=replace(x.run, seed=x.run.seed + i))) for i in range(seeds)]


def compare_sources(
    graphs: list[Graph],
    results: Results,
    sources: Callable[[Graph], Mapping[str, DetectorStage]],
    tests: Callable[[Graph], Mapping[str, TargetSetsStage]],
    draws: int,
) -> SideBySide:
    """Score the detectors of every source and seed on every test set, and compare the first source with the others.

    All detectors of a seed are scored on the same test images, so that differences are paired.

    Args:
        graphs: one graph per seed.
        results: results of stages.
        sources: returns the detectors of a graph, by the source of their training images.
        tests: returns the target sets of a graph, by name.
        draws: bootstrap draws over test images.
    """
    outcomes: dict[str, dict[str, list[list[Outcomes]]]] = {}
    images: dict[str, int] = {}
    names = list(graphs[0].names)
    for graph in graphs:
        for kind, targets in tests(graph).items():
            test = results(targets).test
            images[kind] = images.get(kind, 0) + len(test)
            for source, stage in sources(graph).items():
                found = results(ScoresStage(stage, targets)).detections
                of_classes = [match(found, test, label) for label in range(len(names))]
                outcomes.setdefault(kind, {}).setdefault(source, []).append(of_classes)
    tables = {kind: ScoreTable.of(rows, names, draws) for kind, rows in outcomes.items()}
    return SideBySide.of(tables, [graph.experiment.run.seed for graph in graphs], images)


@dataclass(frozen=True)
class Samples:
    """Training images of every source: how many there are, and some of them for a figure.

    Attributes:
        counts: number of training images by source.
        shown: equally many of every source, source by source.
    """

    counts: Mapping[str, int]
    shown: LabelledImages

    @staticmethod
    def of(results: Results, sources: Mapping[str, DetectorStage], most: int) -> Samples:
        """Choose ``most`` evenly spaced images of every source, or as many as the smallest one has.

        If the sources share their draws, the images show the same scenes.
        """
        counts, parts = {}, []
        for name, stage in sources.items():
            images = stage.images(results).images.to("cpu")
            counts[name] = len(images)
            parts.append(images.select(figures.spread(images, most)))
        fewest = min(len(part) for part in parts)
        equal = [part.select(figures.spread(part, fewest)) for part in parts]
        return Samples(counts, LabelledImages.concatenate(equal))


def publish(
    context: Context,
    found: SideBySide,
    samples: Samples,
    heading: str,
    more: Mapping[str, object] | None = None,
    text: str = "",
    figure: Figure | None = None,
) -> Run | None:
    """Write the table, the document and the figures, and log the AP of every source to MLflow.

    Args:
        context: context of the study.
        found: the scores.
        samples: training images of every source.
        heading: sentence that introduces the sources.
        more: further entries of the document.
        text: text below the tables.
        figure: a figure of held-out views.
    """
    classes = list(next(iter(found.per_class.values()))[found.sources[0]])
    rows = "; ".join(f"row {i + 1}: {source}" for i, source in enumerate(found.sources))
    columns = len(samples.shown) // len(found.sources)
    grid = figures.image_grid(samples.shown, classes, columns, title=f"Training images, {rows}")
    numbers = ", ".join(f"{count} of {source}" for source, count in samples.counts.items())
    parts = [table(found, f"{heading} Training images with the first seed: {numbers}."), text]
    metrics = {
        f"{kind}/{source}/ap": estimate.value
        for kind, row in found.ap.items()
        for source, estimate in row.items()
    }
    return context.publish(
        context.config["name"],
        {**dataclasses.asdict(found), "training_images": samples.counts, **(more or {})},
        "\n\n".join(part for part in parts if part),
        {"ap": ap_figure(found, heading), "training_images": grid} | ({"held_out": figure} if figure else {}),
        metrics,
    )


def table(found: SideBySide, heading: str) -> str:
    """Return Markdown tables of AP by test set, with the first source's leads, and of AP by class."""
    first, *others = found.sources
    several = len(found.seeds) > 1
    over = "seeds and test images" if several else "test images"
    introduction = (
        f"{heading} AP (0.50 to 0.95) in points, the mean over classes, with 95 % intervals over {over}; "
        f"seed{'s' if several else ''} {', '.join(map(str, found.seeds))}."
        + (" Differences are in bold if their interval excludes 0." if several else "")
    )
    head = ["test set", "images", *found.sources, *(f"{first} ahead of {other} by" for other in others)]
    rows = [
        [kind, found.images[kind]]
        + [points(row[source]) for source in found.sources]
        + [points(found.ahead[kind][other], sure=several) for other in others]
        for kind, row in found.ap.items()
    ]
    by_class = [
        [f"{kind}, {name}", *(f"{100 * by_source[source][name]:.1f}" for source in found.sources)]
        for kind, by_source in found.per_class.items()
        for name in by_source[first]
    ]
    tables = [markdown_table(head, rows), markdown_table(["test set, class", *found.sources], by_class)]
    return "\n\n".join([introduction, *tables])


def ap_figure(found: SideBySide, title: str) -> Figure:
    """Draw a group of bars per test set, with one bar and its interval per source."""
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
    figures.titled(figure, title, 10)
    axes.yaxis.grid(color=GRID)
    axes.set_axisbelow(True)
    figures.style(axes)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False, title="trained on")
    return figure
