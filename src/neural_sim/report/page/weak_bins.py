"""AP by the bin of the target images: where the detector is still weak."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from neural_sim.report.bootstrap import average_precision, match
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class BinScore:
    """AP (a fraction) of an object on the test images that show it from one bin (from 1), for two detectors.

    ``fraction`` is the part of the object's test images that are from this bin.
    """

    name: str
    bin: int
    images: int
    fraction: float
    start: float
    learned: float

    @property
    def missing(self) -> float:
        """What this bin takes from the object's AP: its part of the images times the AP that it lacks."""
        return self.fraction * (1.0 - self.learned)


def bin_scores(
    names: Sequence[str],
    detections: Mapping[str, Sequence[Mapping[str, Tensor]]],
    test: LabelledImages,
    at_least: int = 5,
) -> list[BinScore]:
    """Every object's bins with ``at_least`` test images or more, by detections of ns and learned. Images of unknown
    bins are left out."""
    scores = []
    for label, name in enumerate(names):
        matches = {which: match(detections[which], test, label) for which in ("ns", "learned")}
        shown = _bins_shown(test, label)
        total = int(shown.any(-1).sum())
        for column in range(shown.shape[1]):
            rows = shown[:, column]
            count = int(rows.sum())
            if count >= at_least:
                start, learned = (average_precision(m, rows.double().numpy()) for m in matches.values())
                scores.append(BinScore(name, column + 1, count, count / total, start, learned))
    return scores


def weakest(scores: Sequence[BinScore], count: int = 3) -> list[BinScore]:
    """The bins that take most from their objects' AP, the worst first."""
    return sorted(scores, key=lambda score: -score.missing)[:count]


def _bins_shown(test: LabelledImages, label: int) -> Bool[Tensor, "images bins"]:
    """Which images show an object from which bin."""
    own = test.labels == label
    bins = test.bins if test.bins.ndim == 2 else test.bins[:, None].expand_as(test.labels)
    known = own & (bins >= 0)
    count = int(bins.max()) + 1 if bins.numel() else 0
    shown = torch.zeros(len(test), max(count, 0), dtype=torch.bool)
    image, box = known.nonzero(as_tuple=True)
    shown[image, bins[image, box]] = True
    return shown
