"""Right and wrong detections of several methods on the same photographs (the paper's Sec. C.2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor
from torchvision.ops import box_iou
from typing_extensions import override

from neural_sim.documents import markdown_table
from neural_sim.ranges import Fraction, PositiveInt, validated
from neural_sim.report.figures import INK, picture, spread, titled
from neural_sim.report.tracking import Run
from neural_sim.stages.evaluate import Scores
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Methods, Task
from neural_sim.types import LabelledImages

RIGHT, WRONG, MISSED = "#2ca25f", "#d7301f", "#ffd23f"
Detections = Mapping[str, Tensor]


@dataclass(frozen=True)
class Judged:
    """The detections that count in one image, best first.

    ``kept`` are their rows among all detections of the image, ``right`` says which of them match a box of their class,
    and ``missed`` which ground-truth boxes have no match.
    """

    kept: Int[Tensor, "d"]
    right: Bool[Tensor, "d"]
    missed: Bool[Tensor, "b"]


@validated
@dataclass(frozen=True)
class DetectionGallery(Task):
    """``+experiment=detection_gallery``: draw and count the detections of several methods on the same photographs.

    Args:
        methods: baselines; each one's detector is trained on the distribution that it learned.
        count: number of photographs to draw, evenly spaced over the test images.
        draw_above: smallest score of a detection that is drawn and counted.
        overlap: smallest intersection over union of a correct detection with a box of its class.
    """

    methods: Methods = ("ns", "neural_sim")
    count: PositiveInt = 6
    draw_above: Fraction = 0.3
    overlap: Fraction = 0.5

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        context.experiment.check_boxes("detection_gallery")
        graphs = context.graphs_of(self.methods, "detection_gallery.methods")
        return [context.graph.targets, *(graph.learned for graph in graphs.values())]

    @override
    def run(self, context: Context) -> None:
        graphs = context.graphs_of(self.methods, "detection_gallery.methods")
        results = context.results
        test = results(context.graph.targets).test
        found = {
            method: results(graph.scores(results(graph.learned).last, f"what {method} learned"))
            for method, graph in graphs.items()
        }
        self.publish(context, test, found, context.graph.names)

    def publish(
        self, context: Context, test: LabelledImages, found: Mapping[str, Scores], class_names: Sequence[str]
    ) -> Run | None:
        """Write detection_gallery.json, detection_gallery.md and the figure, and log counts and AP to MLflow."""
        rows = spread(test, self.count)
        verdicts = {
            method: judged(own.detections, test, self.draw_above, self.overlap)
            for method, own in found.items()
        }
        methods: dict[str, dict[str, float]] = {
            method: {**count(verdicts[method]), "ap": own.ap.ap, "ap50": own.ap.ap50}  # pyright: ignore[reportAttributeAccessIssue]  (boxes)
            for method, own in found.items()
        }
        note = (
            f"Detections with a score of at least {self.draw_above:g} on {len(test)} test images. A detection is right "
            f"if it is the best one that overlaps a box of its class by at least {self.overlap:g}."
        )
        head = ["method", "right", "wrong", "missed boxes", "AP (0.50 to 0.95)", "AP50"]
        cells = [
            [method, *(own[key] for key in ("right", "wrong", "missed"))]
            + [f"{100 * own[key]:.1f}" for key in ("ap", "ap50")]
            for method, own in methods.items()
        ]
        detections = {method: own.detections for method, own in found.items()}
        return context.publish(
            "detection_gallery",
            {"images": len(test), "shown": rows.tolist(), "methods": methods},
            f"{note}\n\n{markdown_table(head, cells)}",
            {"detections": detections_figure(test, detections, verdicts, class_names, rows)},
            {f"{method}/{key}": value for method, own in methods.items() for key, value in own.items()},
        )


def judge(
    found: Detections, boxes: Float[Tensor, "b 4"], labels: Int[Tensor, "b"], above: float, overlap: float
) -> Judged:
    """Tell right detections in one image from wrong ones.

    From the best down, each detection is matched to the free box of its class that it overlaps most, if by at least
    ``overlap``. A detection of a box that is already matched is wrong.
    """
    order = found["scores"].argsort(descending=True, stable=True)
    kept = order[found["scores"][order] >= above]
    ious = box_iou(found["boxes"][kept].float(), boxes.float())
    ious = torch.where(found["labels"][kept][:, None] == labels[None], ious, -1.0)
    free = torch.ones(len(boxes), dtype=torch.bool)
    right = torch.zeros(len(kept), dtype=torch.bool)
    for row, values in enumerate(ious):
        candidates = torch.where(free, values, -1.0)
        if len(candidates) and float(candidates.max()) >= overlap:
            free[candidates.argmax()] = False
            right[row] = True
    return Judged(kept, right, free)


def judged(found: Sequence[Detections], test: LabelledImages, above: float, overlap: float) -> list[Judged]:
    """Judge the detections of every test image."""
    truth = zip(test.boxes, test.labels, test.present, strict=True)
    return [
        judge(each, boxes[there], labels[there], above, overlap)
        for each, (boxes, labels, there) in zip(found, truth, strict=True)
    ]


def count(images: Sequence[Judged]) -> dict[str, int]:
    """Count right and wrong detections, and missed boxes."""
    right = sum(int(each.right.sum()) for each in images)
    kept, missed = sum(len(each.kept) for each in images), sum(int(each.missed.sum()) for each in images)
    return {"right": right, "wrong": kept - right, "missed": missed}


def detections_figure(
    test: LabelledImages,
    found: Mapping[str, Sequence[Detections]],
    verdicts: Mapping[str, Sequence[Judged]],
    class_names: Sequence[str],
    rows: Int[Tensor, "n"],
) -> Figure:
    """Draw one row per method and one column for each of the test images ``rows``."""
    height, width = test.images.shape[-2:]
    side = 2.1
    figure = Figure(
        figsize=(side * len(rows) + 0.3, side * height / width * len(found) + 0.25 * len(found) + 0.8),
        layout="constrained",
    )
    grid = figure.subplots(len(found), len(rows), squeeze=False)
    for line, (method, every) in enumerate(found.items()):
        for column, row in enumerate(rows.tolist()):
            axes = grid[line, column]
            pixels = test.images[row].clamp(0.0, 1.0).movedim(0, -1).cpu().numpy()
            picture(axes, pixels, extent=(0, width, height, 0))
            missed = test.boxes[row][test.present[row]][verdicts[method][row].missed]
            _draw(axes, every[row], verdicts[method][row], missed, class_names, width)
            axes.set(xlim=(0, width), ylim=(height, 0))
        grid[line, 0].set_ylabel(method, color=INK, fontsize=9)
    handles = [Rectangle((0, 0), 1, 1, fill=False, edgecolor=RIGHT, linewidth=1.6),
               Rectangle((0, 0), 1, 1, fill=False, edgecolor=WRONG, linewidth=1.6),
               Rectangle((0, 0), 1, 1, fill=False, edgecolor=MISSED, linewidth=1.2, linestyle="--")]  # fmt: skip
    figure.legend(
        handles, ["right", "wrong", "missed"], loc="outside lower center", ncols=3, frameon=False, fontsize=8
    )
    titled(figure, "Detections on the test images")
    return figure


def _draw(
    axes: Any, found: Detections, verdict: Judged, missed: Tensor, class_names: Sequence[str], width: int
) -> None:
    for box in missed.tolist():
        _box(axes, box, MISSED, dashed=True)
    lowest = list(zip(verdict.kept.tolist(), verdict.right.tolist(), strict=True))[::-1]  # the best on top
    for index, right in lowest:
        colour, (x0, y0, x1, y1) = RIGHT if right else WRONG, found["boxes"][index].tolist()
        _box(axes, (x0, y0, x1, y1), colour, dashed=False)
        name = class_names[int(found["labels"][index])]
        text = f"{name} {float(found['scores'][index]):.2f}"
        inside = y0 < 0.06 * width  # no room above the box
        left = x0 + x1 < width  # the side with more room
        axes.text(
            max(x0, 0.0) if left else min(x1, width), y0, text, fontsize=5.5, color="white", clip_on=True,
            ha="left" if left else "right", va="top" if inside else "bottom",
            bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8, "alpha": 0.85},
        )  # fmt: skip


def _box(axes: Any, box: Sequence[float], colour: str, dashed: bool) -> None:
    x0, y0, x1, y1 = box
    width, style = (1.2, "--") if dashed else (1.6, "-")
    axes.add_patch(
        Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=width, linestyle=style)
    )
