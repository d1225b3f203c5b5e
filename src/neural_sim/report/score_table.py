"""Scores of detectors over seeds, classes and test images: the one place that computes means, intervals and leads.

All detectors of a seed are scored on one test set, so that comparisons are paired, by seed and by image. Intervals come
from a bootstrap over test images that evaluates each detector only once: whether a detection is matched depends on its
own image only. Drawing images with replacement therefore only changes how often each detection and each box counts. AP
is then a weighted sum over detections in the order of their scores, and accuracy a weighted mean over images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torchvision.ops import box_iou

from neural_sim.detector.metrics import best_classes
from neural_sim.detector.protocol import Score
from neural_sim.report.intervals import Estimate, Sample, over_seeds_and_images, ratio
from neural_sim.types import LabelledImages

# Rounded to float32 as in torchmetrics, because it decides on which side of 0.28 a recall of exactly 0.28 falls.
THRESHOLDS = torch.linspace(0.5, 0.95, 10).double().numpy()
RECALLS = torch.linspace(0.0, 1.0, 101).double().numpy()


@dataclass(frozen=True)
class Matches:
    """Detections of one class in a test set, best first, and whether each is correct at each COCO threshold."""

    image: Int[np.ndarray, "detections"]
    correct: Bool[np.ndarray, "detections thresholds"]
    boxes_per_image: Int[np.ndarray, "images"]


@dataclass(frozen=True)
class Hits:
    """Images of one class (where ``boxes_per_image`` is 1), and whether each image's best class is this one."""

    correct: Bool[np.ndarray, "images"]
    boxes_per_image: Int[np.ndarray, "images"]


Outcomes = Matches | Hits
"""The outcomes from which the score of one class in a test set is computed."""


def match(
    predictions: Sequence[Mapping[str, Tensor]], images: LabelledImages, label: int, score: Score = "AP"
) -> Outcomes:
    """Match the predictions of one class with its labels, as the basis of the class's score.

    For AP, detections are matched by COCO's rules: in each image from the best down, each to the unmatched box that it
    overlaps most.

    Args:
        predictions: the predictions on every image.
        images: the images with their boxes.
        label: the class.
        score: AP or accuracy.
    """
    if score == "accuracy":
        own = (images.labels == label).any(1).cpu().numpy().astype(int)
        return Hits((best_classes(predictions) == label).numpy(), own)
    rows, scores, correct, counts = [], [], [], []
    for index, detections in enumerate(predictions):
        truth = images.boxes[index][images.labels[index] == label]
        counts.append(len(truth))
        own = detections["labels"] == label
        order = detections["scores"][own].argsort(descending=True, stable=True)[:100]
        if len(truth):
            overlap = box_iou(detections["boxes"][own][order].float(), truth.float()).numpy()
        else:  # a shortcut, because most images show other objects
            overlap = np.zeros((len(order), 0))
        rows += [index] * len(order)
        scores += detections["scores"][own][order].tolist()
        correct += list(_greedy(overlap))
    best_first = np.argsort(-np.asarray(scores), kind="stable")
    table = np.asarray(correct, dtype=bool).reshape(len(rows), len(THRESHOLDS))
    return Matches(np.asarray(rows, dtype=int)[best_first], table[best_first], np.asarray(counts))


def _greedy(overlap: Float[np.ndarray, "detections boxes"]) -> Bool[np.ndarray, "detections thresholds"]:
    correct = np.zeros((overlap.shape[0], len(THRESHOLDS)), dtype=bool)
    if overlap.shape[1] == 0:
        return correct
    free = np.ones((len(THRESHOLDS), overlap.shape[1]), dtype=bool)
    every = np.arange(len(THRESHOLDS))
    for d, row in enumerate(overlap):
        candidates = np.where(free, row, -1.0)
        best = candidates.argmax(1)
        correct[d] = candidates[every, best] >= THRESHOLDS
        free[every, best] &= ~correct[d]
    return correct


def class_score(outcomes: Outcomes, weights: Float[np.ndarray, "images"] | None = None) -> float:
    """Return the score of one class, nan without a box; ``weights`` say how often each image counts."""
    if isinstance(outcomes, Matches):
        return average_precision(outcomes, weights)
    shown = outcomes.boxes_per_image * (1.0 if weights is None else weights)
    total = float(shown.sum())
    return float((shown * outcomes.correct).sum() / total) if total else float("nan")


def average_precision(matches: Matches, weights: Float[np.ndarray, "images"] | None = None) -> float:
    """Return AP from 101 recalls, averaged over COCO's thresholds; nan without a box. ``weights`` weigh the images."""
    weights = np.ones(len(matches.boxes_per_image)) if weights is None else weights
    boxes = float((weights * matches.boxes_per_image).sum())
    if boxes == 0.0:
        return float("nan")
    each = weights[matches.image][:, None]
    right = (each * matches.correct).cumsum(0)
    total = each.cumsum(0)
    precision = np.maximum.accumulate((right / np.maximum(total, 1e-12))[::-1])[::-1]
    recall = right / boxes
    values = []
    for t in range(len(THRESHOLDS)):
        at = np.searchsorted(recall[:, t], RECALLS, side="left")
        values.append(precision[at[at < len(recall)], t].sum() / len(RECALLS))
    return float(np.mean(values))


def class_scores(
    matches: Sequence[Sequence[Sequence[Outcomes]]], draws: int, seed: int = 0
) -> tuple[Float[np.ndarray, "groups rows classes"], Float[np.ndarray, "draws groups rows classes"]]:
    """Return the scores of ``matches`` [group][detector][class], on the test images and on resampled ones.

    All test sets of the same size are resampled alike, so that differences between detectors that share a test set are
    paired.
    """
    random = np.random.default_rng(seed)
    counts = sorted({len(outcomes.boxes_per_image) for group in matches for row in group for outcomes in row})

    def scored(weights: Mapping[int, Float[np.ndarray, "_"] | None]) -> list[list[list[float]]]:
        return [
            [[class_score(o, weights[len(o.boxes_per_image)]) for o in row] for row in g] for g in matches
        ]

    def drawn() -> dict[int, Float[np.ndarray, "_"]]:
        return {n: np.bincount(random.integers(n, size=n), minlength=n).astype(float) for n in counts}

    point = np.asarray(scored(dict.fromkeys(counts)))
    return point, np.asarray([scored(drawn()) for _ in range(draws)])


def mean_of_known(scores: Float[np.ndarray, "*rows classes"]) -> Float[np.ndarray, "*rows"]:
    """Return the mean over the classes that have a score; nan if none has one."""
    known = ~np.isnan(scores)
    counts = known.sum(-1)
    return np.where(counts, np.where(known, scores, 0.0).sum(-1) / np.maximum(counts, 1), np.nan)


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of one detector's score, averaged over the detectors of a table.

    Args:
        seeds: standard deviation between seeds, or between trainings on one distribution.
        images: standard deviation over resampled test images.
    """

    seeds: float
    images: float


@dataclass(frozen=True)
class ScoreTable:
    """Scores (AP or accuracy, fractions) of detectors that were trained once for each seed.

    The score of several classes is the mean over those that the test images show.

    Args:
        detectors: names of methods, of distributions or of sources of images.
        classes: names of the classes.
        point: the scores, nan for a class without a box.
        spread: the scores under resampled test images, the same ones for all detectors of a seed.
    """

    detectors: tuple[str, ...]
    classes: tuple[str, ...]
    point: Float[np.ndarray, "detectors seeds classes"]
    spread: Float[np.ndarray, "draws detectors seeds classes"]

    @staticmethod
    def of(
        outcomes: Mapping[str, Sequence[Sequence[Outcomes]]],
        classes: Sequence[str],
        draws: int,
        seed: int = 0,
    ) -> ScoreTable:
        """Score detectors on their test images and on ``draws`` resampled sets of them.

        Args:
            outcomes: outcomes of every detector, [seed][class].
            classes: names of the classes, in the order of ``outcomes``.
            draws: number of bootstrap draws over test images.
            seed: seed of the bootstrap.
        """
        point, spread = class_scores(list(outcomes.values()), draws, seed)
        return ScoreTable(tuple(outcomes), tuple(classes), point, spread)

    @property
    def shown(self) -> list[str]:
        """The classes that the test images of any seed show."""
        absent = np.isnan(self.point[0]).all(0)
        return [name for name, missing in zip(self.classes, absent, strict=True) if not missing]

    def of_classes(self, names: Sequence[str]) -> ScoreTable:
        """Return the table restricted to some classes."""
        labels = [self.classes.index(name) for name in names]
        return ScoreTable(self.detectors, tuple(names), self.point[..., labels], self.spread[..., labels])

    def sample(self, detector: str) -> Sample:
        """Return a detector's mean over classes for every seed, and under resampled test images."""
        place = self.detectors.index(detector)
        return mean_of_known(self.point[place]), mean_of_known(self.spread[:, place])

    def mean(self, detector: str) -> Estimate:
        """Return a detector's mean score over classes and seeds, with its interval within [0, 1]."""
        return over_seeds_and_images(*self.sample(detector)).as_fraction

    def ahead(self, first: str, second: str) -> Estimate:
        """Return the first detector's lead in mean score over the second."""
        return over_seeds_and_images(*_minus(self.sample(first), self.sample(second)))

    def closed(self, detector: str, start: str = "ns", goal: str = "matched") -> Estimate:
        """Return the fraction of the gap from ``start`` to ``goal`` that a detector closes, with Fieller's interval."""
        start_of, goal_of = self.sample(start), self.sample(goal)
        return ratio(_minus(self.sample(detector), start_of), _minus(goal_of, start_of))

    def by_class(self, detector: str) -> dict[str, float]:
        """Return a detector's score of every class, the mean over the seeds whose test images show it."""
        means = mean_of_known(self.point[self.detectors.index(detector)].T)
        return dict(zip(self.classes, means.tolist(), strict=True))

    def scatter(self) -> Scatter:
        """Return the scatter of one detector's mean score over classes; needs at least two seeds."""
        point, spread = mean_of_known(self.point), mean_of_known(self.spread)
        between, over_images = point.var(1, ddof=1).mean(), np.nanvar(spread, 0, ddof=1).mean()
        return Scatter(float(np.sqrt(between)), float(np.sqrt(over_images)))


def _minus(a: Sample, b: Sample) -> Sample:
    return a[0] - b[0], a[1] - b[1]
