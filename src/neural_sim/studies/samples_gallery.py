"""Training images from the distribution that each method learned, next to test images (the paper's Sec. C.1)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from typing_extensions import override

from neural_sim.documents import markdown_table
from neural_sim.parameter.distributions import total_variation
from neural_sim.ranges import PositiveInt, validated
from neural_sim.report.figures import INK, spread, titled
from neural_sim.report.tracking import Run
from neural_sim.stages.graph import Graph, Psi
from neural_sim.stages.stage import Results, Stage
from neural_sim.tasks.context import Context, Methods, Task
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class Samples:
    """Training images of one object by method, and test images that show it.

    ``distances`` are, by method, the total variation of each factor from the target's, None if that is unknown.
    """

    object: str
    images: Mapping[str, LabelledImages]
    test: LabelledImages
    distances: Mapping[str, Mapping[str, float] | None]


@validated
@dataclass(frozen=True)
class SamplesGallery(Task):
    """``+experiment=samples_gallery``: draw training images from what each method learned, next to test images.

    Args:
        methods: baselines that learn psi, each with its own settings.
        count: number of images of each object.
        columns: number of images per row.
        objects: names of the objects to show; None: those with a biased start.
    """

    methods: Methods = ("neural_sim", "auto_sim")
    count: PositiveInt = 18
    columns: PositiveInt = 9
    objects: Sequence[str] | None = None

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        names, known = self._names(context), context.graph.names
        if not names:
            raise ValueError(
                f"samples_gallery.objects: no object has a biased start, want some of {list(known)}"
            )
        if set(names) - set(known):
            raise ValueError(f"samples_gallery.objects: want some of {list(known)}, got {list(names)}")
        graphs = context.graphs_of(self.methods, "samples_gallery.methods")
        return [context.graph.targets, *(graph.learned for graph in graphs.values())]

    def _names(self, context: Context) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.objects or context.experiment.imaging.distribution.biased))

    @override
    def run(self, context: Context) -> None:
        graph, names = context.graph, self._names(context)
        graphs = context.graphs_of(self.methods, "samples_gallery.methods")
        results = context.results
        learned = {method: results(other.learned).last for method, other in graphs.items()}
        drawn = {method: self._drawn(graphs[method], results, psi) for method, psi in learned.items()}
        test = results(graph.targets).test
        samples = []
        for name in names:
            label = graph.names.index(name)
            images = {method: parts[label] for method, parts in drawn.items()}
            distances = {method: _distance(graphs[method], psi, label) for method, psi in learned.items()}
            samples.append(Samples(name, images, self._shown(test, label), distances))
        publish(context, samples, self.columns)

    def _drawn(self, graph: Graph, results: Results, psi: Psi) -> list[LabelledImages]:
        """Draw ``count`` images of every object from its learned distribution."""
        generator = torch.Generator().manual_seed(graph.experiment.run.seed)
        rendered = results(graph.scene).training_set(psi, self.count, generator)
        images = rendered.images.to("cpu")
        # An image may show other objects, too; the rows are sorted by the object that each was drawn for.
        return [
            images.select(torch.arange(label * self.count, (label + 1) * self.count))
            for label in range(len(graph.names))
        ]

    def _shown(self, test: LabelledImages, label: int) -> LabelledImages:
        """Choose test images that show an object, evenly spaced."""
        rows = (test.labels == label).any(-1).nonzero().squeeze(-1)
        return test.select(rows[spread(rows, self.count)])


def _distance(graph: Graph, psi: Psi, label: int) -> dict[str, float] | None:
    """Return the total variation from the target by factor; None if the target's p is unknown."""
    imaging, target = graph.experiment.imaging, graph.target_psi
    if target is None:
        return None
    found, wanted = (imaging.distribution.probabilities(p) for p in (psi, target))
    return {name: float(total_variation(found[name][label], wanted[name][label])) for name in wanted}


def publish(context: Context, samples: Sequence[Samples], columns: int) -> Run | None:
    """Write samples_gallery.json, samples_gallery.md and a figure per object, and log the distances to MLflow."""
    document = {
        each.object: {
            "images": {method: len(images) for method, images in each.images.items()},
            "test": len(each.test),
            "total_variation": dict(each.distances),
        }
        for each in samples
    }
    metrics = {
        f"{each.object}/{factor}/{method}": value
        for each in samples
        for method, distances in each.distances.items()
        for factor, value in (distances or {}).items()
    }
    drawn = {each.object: samples_figure(each, columns) for each in samples}
    return context.publish("samples_gallery", document, table(samples), drawn, metrics)


def table(samples: Sequence[Samples]) -> str:
    """Return a Markdown table of distances by object and factor, if any target is known."""
    if all(known is None for each in samples for known in each.distances.values()):
        return "The target's distribution is unknown, and so are distances to it; figures/ has images of each object."
    methods = list(samples[0].images)
    rows = [
        [f"{each.object}, {factor}", *(f"{(each.distances[method] or {})[factor]:.2f}" for method in methods)]
        for each in samples
        for factor in dict.fromkeys(factor for known in each.distances.values() for factor in known or {})
    ]
    note = "Total variation of learned distributions from the target's; figures/ has images of each object."
    return f"{note}\n\n{markdown_table(['object, factor', *methods], rows)}"


def samples_figure(samples: Samples, columns: int) -> Figure:
    """Draw a panel per method and one of test images, each with ``columns`` images per row."""
    panels = {
        method: (images, _caption(samples.distances[method])) for method, images in samples.images.items()
    }
    panels["test images"] = (samples.test, "")
    heights = [0.4 + 1.05 * -(-len(images) // columns) for images, _ in panels.values()]
    total = sum(heights) + 0.35
    figure = Figure(figsize=(max(1.05 * columns + 0.2, 4.5), total))  # at least as wide as its captions
    top = total - 0.35
    for (name, (images, caption)), height in zip(panels.items(), heights, strict=True):
        axes = figure.add_axes((0.01, (top - height) / total, 0.98, (height - 0.4) / total))
        axes.imshow(_canvas(images, columns))
        axes.set_anchor("W")  # with its caption, if the figure is wider than the images
        axes.set_axis_off()
        axes.set_title(name + caption, loc="left", color=INK, fontsize=9)
        top -= height
    titled(figure, f"{samples.object}: images of what each method learned")
    return figure


def _caption(distances: Mapping[str, float] | None) -> str:
    parts = [f"{factor} {value:.2f}" for factor, value in (distances or {}).items()]
    return f" (total variation from the target: {', '.join(parts)})" if parts else ""


def _canvas(images: LabelledImages, columns: int) -> np.ndarray:
    """Lay out images row by row, with white gaps."""
    height, width = images.images.shape[-2:]
    gap, rows = max(1, width // 32), max(1, -(-len(images) // columns))
    canvas = np.ones((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), dtype=np.float32)
    for i, image in enumerate(images.images.clamp(0.0, 1.0).movedim(1, -1).cpu().numpy()):
        y, x = i // columns * (height + gap), i % columns * (width + gap)
        canvas[y : y + height, x : x + width] = image
    return canvas
