"""Score predictions: average precision by the COCO definitions, or top-1 accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor
from torchmetrics.detection import MeanAveragePrecision

from neural_sim.detector.classifier import class_of
from neural_sim.detector.protocol import Score
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class AveragePrecision:
    """Average precision; a class without a box is nan and is left out of the means.

    Attributes:
        ap: mean over overlaps from 0.50 to 0.95 and over classes.
        ap50: mean over classes at an overlap of 0.50.
        per_class: ``ap`` by class name.
        per_class_ap50: ``ap50`` by class name.
    """

    ap: float
    ap50: float
    per_class: dict[str, float]
    per_class_ap50: dict[str, float]

    @property
    def mean(self) -> float:
        """The mean over classes."""
        return self.ap


@dataclass(frozen=True)
class Accuracy:
    """Top-1 accuracy; a class without an image is nan and is left out of the mean.

    Attributes:
        accuracy: mean over classes of the fraction of a class's images whose best class is right.
        per_class: that fraction by class name.
    """

    accuracy: float
    per_class: dict[str, float]

    @property
    def mean(self) -> float:
        """The mean over classes."""
        return self.accuracy


TestScore = AveragePrecision | Accuracy
IN_FULL: dict[Score, str] = {"AP": "AP (0.50 to 0.95)", "accuracy": "Top-1 accuracy"}
"""Names of the scores in tables."""


def of_document(document: Mapping[str, Any]) -> TestScore:
    """Read a score from its dictionary in results.json or the store; the fields tell which kind it is."""
    return AveragePrecision(**document) if "ap" in document else Accuracy(**document)


def mean_of(document: Mapping[str, Any]) -> float:
    """Return the mean over classes from a score's dictionary (see ``of_document``)."""
    return document["ap"] if "ap" in document else document["accuracy"]


def mean_over(document: Mapping[str, Any], names: Iterable[str]) -> float:
    """Return the mean of a score's dictionary over those of the named classes that have a score; nan if none has."""
    scores = (document["per_class"][name] for name in names)
    return _mean([value for value in scores if value is not None])  # JSON has null for nan


def evaluate(
    predictions: Sequence[dict[str, Tensor]],
    images: LabelledImages,
    class_names: Sequence[str],
    score: Score = "AP",
) -> TestScore:
    """Score ``predictions``, one dictionary for each image, as returned by ``Detector.predict``.

    Raises:
        ValueError: there are no images, predictions and images differ in number, a label has no name, or the score is
            accuracy and an image shows objects of two classes.
    """
    if len(images) == 0:
        raise ValueError("evaluate: got no images, want at least one")
    if len(predictions) != len(images):
        raise ValueError(
            f"evaluate: want one prediction per image, got {len(predictions)} for {len(images)} images"
        )
    labels = images.labels[images.present]
    if labels.numel() and int(labels.max()) >= len(class_names):
        raise ValueError(f"evaluate: label {int(labels.max())} has no name among {list(class_names)}")
    if score == "accuracy":
        return _accuracy(predictions, images, class_names)
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


def worthless(score: TestScore, predictions: Sequence[Mapping[str, Tensor]]) -> str | None:
    """Explain in one line why a score is meaningless and what to do; None if it is meaningful."""
    known = [value for value in score.per_class.values() if value == value]
    if not known:
        return "no class has a box in these images, so nothing is scored: want labels of the objects' classes"
    if any(known):
        return None
    if isinstance(score, Accuracy):
        return (
            "it is 0 for every class: no image's best class is right; want more training, or training images that look "
            "more like these"
        )
    count = sum(len(each["scores"]) for each in predictions)
    why = f"none of its {count} boxes lies on an object of its class" if count else "it detects nothing"
    return (
        f"it is 0 for every class: {why}; want more training.cold_epochs, or training images whose objects are as "
        "large as those in these images"
    )


def best_classes(predictions: Sequence[Mapping[str, Tensor]]) -> Int[Tensor, "images"]:
    """Return the class of each image's best prediction; -1 if there is none."""
    best = [p["labels"][p["scores"].argmax()] if len(p["scores"]) else -1 for p in predictions]
    return torch.tensor([int(label) for label in best])


def _accuracy(
    predictions: Sequence[Mapping[str, Tensor]], images: LabelledImages, class_names: Sequence[str]
) -> Accuracy:
    own, best = class_of(images.labels.cpu()), best_classes(predictions)
    right = [(best == label)[own == label].double().mean() for label in range(len(class_names))]
    per_class = [float(value) for value in right]  # the mean of nothing is nan
    return Accuracy(_mean(per_class), dict(zip(class_names, per_class, strict=True)))


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
        # COCO's -1 stands for "no ground truth"; a class that is only predicted counts as absent as well.
        if int(label) in present:
            values[int(label)] = float(value)
    return values


def _mean(values: list[float]) -> float:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")
