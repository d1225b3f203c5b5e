"""Average precision by the COCO definitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor
from torchmetrics.detection import MeanAveragePrecision

from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class AveragePrecision:
    """``ap`` is the mean over overlaps 0.50 to 0.95 and classes, ``ap50`` that at an overlap of 0.50; both by class
    name, too. A class without a box is nan and stays out of the means."""

    ap: float
    ap50: float
    per_class: dict[str, float]
    per_class_ap50: dict[str, float]


def evaluate(
    predictions: Sequence[dict[str, Tensor]], images: LabelledImages, class_names: Sequence[str]
) -> AveragePrecision:
    """Average precision of ``predictions`` (one dictionary an image, as :meth:`Detector.predict` gives).

    Raises:
        ValueError: where there are no images, predictions and images differ in number, or a label has no name.
    """
    if len(images) == 0:
        raise ValueError("evaluate: got no images, want at least one")
    if len(predictions) != len(images):
        raise ValueError(
            f"evaluate: want a prediction an image, got {len(predictions)} for {len(images)} images"
        )
    labels = images.labels[images.present]
    if labels.numel() and int(labels.max()) >= len(class_names):
        raise ValueError(f"evaluate: label {int(labels.max())} has no name among {list(class_names)}")
    truth = [
        {"boxes": boxes[present].float().cpu(), "labels": label[present].cpu()}
        for boxes, label, present in zip(images.boxes, images.labels, images.present, strict=True)
    ]
    detections = [{key: _single(value) for key, value in prediction.items()} for prediction in predictions]
    per_class = _average_precision(detections, truth, None, len(class_names))
    per_class_50 = _average_precision(detections, truth, [0.5], len(class_names))
    return AveragePrecision(
        _mean(per_class),
        _mean(per_class_50),
        dict(zip(class_names, per_class, strict=True)),
        dict(zip(class_names, per_class_50, strict=True)),
    )


def _single(value: Tensor) -> Tensor:
    value = value.detach().cpu()
    return value.float() if value.is_floating_point() else value


def _average_precision(
    detections: list[dict[str, Tensor]],
    truth: list[dict[str, Tensor]],
    thresholds: list[float] | None,
    classes: int,
) -> list[float]:
    metric = MeanAveragePrecision(
        iou_thresholds=thresholds,
        class_metrics=True,
        backend="faster_coco_eval",
        max_detection_thresholds=[1, 10, 100],
    )
    metric.warn_on_many_detections = False
    metric.update(detections, truth)
    result = metric.compute()
    values = [float("nan")] * classes
    present = {int(label) for image in truth for label in image["labels"]}
    for label, value in zip(result["classes"].reshape(-1), result["map_per_class"].reshape(-1), strict=True):
        # COCO's -1 stands for "no ground truth"; a class only predicted is absent as well.
        if int(label) in present:
            values[int(label)] = float(value)
    return values


def _mean(values: list[float]) -> float:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")
