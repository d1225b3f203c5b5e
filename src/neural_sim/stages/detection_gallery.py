"""Stage ``detection_gallery``: detections of several methods on the same photographs, as
conf/experiment/detection_gallery.yaml says.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from neural_sim.checks import at_least
from neural_sim.report.detection_gallery import report_detections
from neural_sim.stages.methods import check_methods, graphs_of_methods
from neural_sim.stages.side_by_side import results_of_study
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class DetectionGalleryStep:
    """The paper's Sec. C.2: detections on photographs, right ones in one colour and wrong ones in another.

    Args:
        methods: baselines; the detector of each is trained on the distribution that it learned.
        count: photographs, evenly spaced over the test images.
        draw_above: smallest score of a detection that is drawn and counted.
        overlap: smallest intersection over union of a right detection with a box of its class.

    Raises:
        ValueError: no method, or a number out of its range.
    """

    methods: Sequence[str] = ("ns", "neural_sim")
    count: int = 6
    draw_above: float = 0.3
    overlap: float = 0.5

    def __post_init__(self) -> None:
        check_methods(self.methods, "detection_gallery.methods")
        at_least("detection_gallery", 1, count=self.count)
        for key in ("draw_above", "overlap"):
            if not 0.0 <= getattr(self, key) <= 1.0:
                raise ValueError(f"detection_gallery.{key} must lie in [0, 1], got {getattr(self, key)}")

    def run(self, context: Context) -> None:
        """The figure, and every method's counts and AP; to the run's folder and MLflow."""
        x, begun = context.experiment, time.time()
        x.check_boxes("detection_gallery")
        graphs = graphs_of_methods(context, self.methods, "detection_gallery.methods")
        results = results_of_study(context)
        test = results(context.graph.targets).test
        found, ap = {}, {}
        for method, graph in graphs.items():
            scores = results(graph.scores(results(graph.learned).last, f"what {method} learned"))
            found[method], ap[method] = scores.detections, scores.ap
        rows = torch.linspace(0, len(test) - 1, min(self.count, len(test))).round().long()
        run = report_detections(
            test, found, ap, list(context.graph.names), rows, self.draw_above, self.overlap,
            x.run.name, x.config, context.uri, context.folder, begun,
        )  # fmt: skip
        print(f"results: {context.folder}\n{run.where}")
