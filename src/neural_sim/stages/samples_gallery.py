"""Stage ``samples_gallery``: training images of the psi that methods learned, beside test images, as
conf/experiment/samples_gallery.yaml says.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from neural_sim.checks import at_least
from neural_sim.parameter.distributions import total_variation
from neural_sim.report.gallery import Samples, report_samples
from neural_sim.stages.graph import Graph, Psi
from neural_sim.stages.methods import check_methods, graphs_of_methods
from neural_sim.stages.side_by_side import results_of_study
from neural_sim.stages.stage import Results
from neural_sim.tasks.context import Context
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class SamplesGalleryStep:
    """The paper's Sec. C.1: images drawn from what each method learned, and test images.

    Args:
        methods: baselines whose psi is learned, with the settings that each would have in a run of its own.
        count: images of each object.
        columns: images in a row.
        objects: names of the objects that are shown; None: those with a biased start.

    Raises:
        ValueError: no method, a number below 1; when it runs, an object that there is not.
    """

    methods: Sequence[str] = ("neural_sim", "auto_sim")
    count: int = 18
    columns: int = 9
    objects: Sequence[str] | None = None

    def __post_init__(self) -> None:
        check_methods(self.methods, "samples_gallery.methods")
        at_least("samples_gallery", 1, count=self.count, columns=self.columns)

    def run(self, context: Context) -> None:
        """A figure for each object, and the distances of the learned distributions; to the run's folder and MLflow."""
        x, graph, begun = context.experiment, context.graph, time.time()
        names = tuple(self.objects or x.imaging.distribution.biased)
        if not names or set(names) - set(graph.names):
            raise ValueError(f"samples_gallery.objects: want some of {list(graph.names)}, got {list(names)}")
        graphs = graphs_of_methods(context, self.methods, "samples_gallery.methods")
        results = results_of_study(context)
        learned = {method: results(other.learned).last for method, other in graphs.items()}
        drawn = {m: self._drawn(graphs[m], results, psi) for m, psi in learned.items()}
        test = results(graph.targets).test
        samples = []
        for name in names:
            label = graph.names.index(name)
            images = {method: parts[label] for method, parts in drawn.items()}
            distances = {m: self._distance(graphs[m], psi, label) for m, psi in learned.items()}
            samples.append(Samples(name, images, self._shown(test, label), distances))
        run = report_samples(samples, self.columns, x.run.name, x.config, context.uri, context.folder, begun)
        print(f"results: {context.folder}\n{run.where}")

    def _drawn(self, graph: Graph, results: Results, psi: Psi) -> list[LabelledImages]:
        """``count`` images of every object from its learned distribution."""
        generator = torch.Generator().manual_seed(graph.experiment.run.seed)
        rendered = results(graph.scene).training_set(psi, self.count, generator)
        images = rendered.images.to("cpu")
        # Of several objects an image: those that are drawn for this one.
        return [
            images.select(torch.arange(label * self.count, (label + 1) * self.count))
            for label in range(len(graph.names))
        ]

    def _shown(self, test: LabelledImages, label: int) -> LabelledImages:
        """Test images that show an object, evenly spaced."""
        rows = (test.labels == label).any(-1).nonzero().squeeze(-1)
        chosen = torch.linspace(0, len(rows) - 1, min(self.count, len(rows))).round().long()
        return test.select(rows[chosen])

    def _distance(self, graph: Graph, psi: Psi, label: int) -> dict[str, float] | None:
        """Total variation to the target by factor; None where the target's p is not known."""
        imaging, target = graph.experiment.imaging, graph.target_psi
        if target is None:
            return None
        found, wanted = (imaging.distribution.probabilities(p) for p in (psi, target))
        return {name: float(total_variation(found[name][label], wanted[name][label])) for name in wanted}
