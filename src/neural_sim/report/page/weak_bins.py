"""AP, or accuracy, by the bin of the target images: where the detector is still weak."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import class_score, match
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class BinScore:
    """Scores of an object on the images that show it from one bin.

    Args:
        name: of the object.
        bin: from 1.
        images: their number.
        fraction: the part of the object's images that are from this bin.
        ap: AP or accuracy (a fraction) by detector, the one in question last.
    """

    name: str
    bin: int
    images: int
    fraction: float
    ap: Mapping[str, float]

    @property
    def last(self) -> float:
        """AP of the detector in question."""
        return [*self.ap.values()][-1]

    @property
    def change(self) -> float:
        """From the first detector to the last."""
        return self.last - next(iter(self.ap.values()))

    @property
    def missing(self) -> float:
        """What this bin takes from the object's AP: its part of the images times the AP that it lacks."""
        return self.fraction * (1.0 - self.last)


def bin_scores(
    names: Sequence[str],
    detections: Mapping[str, Sequence[Mapping[str, Tensor]]],
    test: LabelledImages,
    at_least: int = 5,
    score: Score = "AP",
) -> list[BinScore]:
    """Score every object's bins that have images enough; images of unknown bins are left out.

    Args:
        names: of the objects.
        detections: of each detector.
        test: the test images.
        at_least: images of a bin.
        score: AP or accuracy.
    """
    scores = []
    for label, name in enumerate(names):
        matches = {which: match(found, test, label, score) for which, found in detections.items()}
        shown = _bins_shown(test, label)
        total = int(shown.any(-1).sum())
        for column in range(shown.shape[1]):
            rows = shown[:, column]
            count = int(rows.sum())
            if count >= at_least:
                weights = rows.double().numpy()
                ap = {which: class_score(m, weights) for which, m in matches.items()}
                scores.append(BinScore(name, column + 1, count, count / total, ap))
    return scores


def weakest(scores: Sequence[BinScore], count: int = 3) -> list[BinScore]:
    """Return the bins that take most from their objects' AP, the worst first."""
    return sorted(scores, key=lambda score: -score.missing)[:count]


def by_object(scores: Sequence[BinScore]) -> dict[str, list[BinScore]]:
    """Group the bins by object."""
    grouped: dict[str, list[BinScore]] = {}
    for score in scores:
        grouped.setdefault(score.name, []).append(score)
    return grouped


def _bins_shown(test: LabelledImages, label: int) -> Bool[Tensor, "images bins"]:
    """Return which images show an object from which bin."""
    own = test.labels == label
    bins = test.bins if test.bins.ndim == 2 else test.bins[:, None].expand_as(test.labels)
    known = own & (bins >= 0)
    count = int(bins.max()) + 1 if bins.numel() else 0
    shown = torch.zeros(len(test), max(count, 0), dtype=torch.bool)
    image, box = known.nonzero(as_tuple=True)
    shown[image, bins[image, box]] = True
    return shown
