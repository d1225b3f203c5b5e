"""AP, or accuracy, by the bin of the target images: where the detector is still weak, and what was forgotten."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import class_score, match
from neural_sim.report.intervals import Estimate
from neural_sim.report.score_table import ScoreTable
from neural_sim.types import LabelledImages

Detections = Mapping[str, Sequence[Mapping[str, Tensor]]]
"""Of every image, by detector."""
LEAST = 0.005
"""Of a score: a smaller gain is not worth a sentence."""
DRAWS = 100
"""Resampled images of a bin, for the interval of what was lost there."""


@dataclass(frozen=True)
class BinScore:
    """Scores of an object on the images that show it from one bin.

    Args:
        name: of the object.
        bin: from 1.
        images: their number.
        fraction: the part of the object's images that are from this bin.
        ap: AP or accuracy (a fraction) by detector: the one before, and perhaps ``learned`` and ``matched``.
    """

    name: str
    bin: int
    images: int
    fraction: float
    ap: Mapping[str, float]

    @property
    def last(self) -> float:
        """AP of the detector in question: that of the learned distribution, if there is one."""
        return self.ap.get("learned", self.first)

    @property
    def first(self) -> float:
        """AP of the detector before."""
        return self.ap["ns"]

    @property
    def change(self) -> float:
        """From the detector before to the one in question."""
        return self.last - self.first


@dataclass(frozen=True)
class Weakness:
    """A bin that scores less than the object's best bin, or than the detector of the target's own distribution there.

    Args:
        score: of the bin.
        best: of the object's best bin.
    """

    score: BinScore
    best: BinScore

    @property
    def own(self) -> float | None:
        """What training on the target's own distribution reaches in this bin; None: not known."""
        return self.score.ap.get("matched")

    @property
    def lacking(self) -> float:
        """AP that the bin lacks."""
        return max(self.best.last, self.own or 0.0) - self.score.last

    @property
    def gain(self) -> float:
        """What that adds to the object's AP, about: its part of the object's images times what it lacks."""
        return self.score.fraction * self.lacking

    @property
    def reason(self) -> str:
        """What it is held against, and what that says of the cause."""
        parts = []
        if self.best.last > self.score.last:
            parts.append(f"bin {self.best.bin} has {100 * self.best.last:.0f}")
        if self.own is not None:
            reached = f"training on the target's own distribution reaches {100 * self.own:.0f} here"
            share = self.own - self.score.last > 0.5 * self.lacking
            hint = (
                "a larger share helps"
                if share
                else "better renders or a longer training may help, its share hardly"
            )
            parts.append(f"{reached}, so {hint}")
        return "; ".join(parts)


@dataclass(frozen=True)
class Forgotten:
    """A bin on whose images the detector in question is certainly worse than the one before, and by how much."""

    score: BinScore
    loss: Estimate


def bin_scores(
    names: Sequence[str],
    detections: Detections,
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
        matches = {called: match(found, test, label, score) for called, found in detections.items()}
        shown = _bins_shown(test, label)
        total = int(shown.any(-1).sum())
        for column in range(shown.shape[1]):
            rows = shown[:, column]
            count = int(rows.sum())
            if count >= at_least:
                weights = rows.double().numpy()
                ap = {called: class_score(m, weights) for called, m in matches.items()}
                scores.append(BinScore(name, column + 1, count, count / total, ap))
    return scores


def weaknesses(scores: Sequence[BinScore], count: int = 5) -> list[Weakness]:
    """Return the bins where most would be won, the largest gain first."""
    found = [
        Weakness(one, max(own, key=lambda other: other.last))
        for own in by_object(scores).values()
        for one in own
    ]
    return [one for one in sorted(found, key=lambda w: -w.gain) if one.gain >= LEAST][:count]


def forgotten(
    scores: Sequence[BinScore],
    names: Sequence[str],
    detections: Detections,
    test: LabelledImages,
    score: Score = "AP",
) -> list[Forgotten]:
    """Return the bins that certainly lost from ns to learned, by resampling their images.

    The one that costs its object most comes first.
    """
    found = []
    for one in scores:
        if one.fraction * -one.change < LEAST:
            continue
        label = names.index(one.name)
        rows = _bins_shown(test, label)[:, one.bin - 1].nonzero()[:, 0]
        shown = test.select(rows)
        outcomes = {
            called: [[match([detections[called][row] for row in rows.tolist()], shown, label, score)]]
            for called in ("ns", "learned")
        }
        loss = ScoreTable.of(outcomes, [one.name], DRAWS).ahead("ns", "learned")
        if loss.certain and loss.value > 0.0:
            found.append(Forgotten(one, loss))
    return sorted(found, key=lambda f: -f.score.fraction * f.loss.value)


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
