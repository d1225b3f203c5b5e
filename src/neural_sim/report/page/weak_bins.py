"""AP or accuracy by bin of the target images, to find where the detector is still weak and what it has forgotten."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from neural_sim.detector.protocol import Score
from neural_sim.report.intervals import Estimate
from neural_sim.report.score_table import ScoreTable, class_score, match
from neural_sim.types import LabelledImages

Detections = Mapping[str, Sequence[Mapping[str, Tensor]]]
"""The detections on every image, by detector."""
LEAST = 0.005
"""Smallest gain or loss in score that is worth a sentence."""
DRAWS = 100
"""Number of times that a bin's images are resampled, for the interval of its loss."""


@dataclass(frozen=True)
class BinScore:
    """Scores of an object on the images that show it from one bin.

    Args:
        name: name of the object.
        bin: number of the bin, from 1.
        images: number of images.
        fraction: fraction of the object's images that are from this bin.
        ap: AP or accuracy (a fraction) by detector: ``ns``, and perhaps ``learned`` and ``matched``.
    """

    name: str
    bin: int
    images: int
    fraction: float
    ap: Mapping[str, float]

    @property
    def last(self) -> float:
        """AP of the detector of the learned distribution; if there is none, of the initial one."""
        return self.ap.get("learned", self.first)

    @property
    def first(self) -> float:
        """AP of the detector of the initial distribution."""
        return self.ap["ns"]

    @property
    def change(self) -> float:
        """Change of AP from the initial to the learned distribution."""
        return self.last - self.first


@dataclass(frozen=True)
class Weakness:
    """A bin that scores less than the object's best bin, or than the detector of the target's own distribution there.

    Args:
        score: scores of the bin.
        best: scores of the object's best bin.
    """

    score: BinScore
    best: BinScore

    @property
    def own(self) -> float | None:
        """AP in this bin after training on the target's own distribution; None: not known."""
        return self.score.ap.get("matched")

    @property
    def lacking(self) -> float:
        """AP by which the bin falls short."""
        return max(self.best.last, self.own or 0.0) - self.score.last

    @property
    def gain(self) -> float:
        """Approximate gain in the object's AP: the bin's fraction of its images, times the AP that it lacks."""
        return self.score.fraction * self.lacking

    @property
    def reason(self) -> str:
        """A text that says what the bin is compared with, and what that suggests about the cause."""
        parts = []
        if self.best.last > self.score.last:
            parts.append(f"bin {self.best.bin} has {100 * self.best.last:.0f}")
        if self.own is not None:
            reached = f"training on the target's own distribution reaches {100 * self.own:.0f} here"
            share = self.own - self.score.last > 0.5 * self.lacking
            hint = (
                "a larger share would help"
                if share
                else "better renders or longer training may help, a larger share hardly"
            )
            parts.append(f"{reached}, so {hint}")
        return "; ".join(parts)


@dataclass(frozen=True)
class Forgotten:
    """A bin in which the detector ``learned`` is significantly worse than ``ns``, and by how much."""

    score: BinScore
    loss: Estimate


def bin_scores(
    names: Sequence[str],
    detections: Detections,
    test: LabelledImages,
    at_least: int = 5,
    score: Score = "AP",
) -> list[BinScore]:
    """Score every object's bins that have enough images; images of unknown bins are left out.

    Args:
        names: names of the objects.
        detections: detections of each detector.
        test: the test images.
        at_least: smallest number of images of a bin.
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
    """Return the bins where most could be gained, the largest gain first."""
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
    """Return the bins with a significant loss from ns to learned, by resampling their images.

    The bin that costs its object most comes first.
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
    """Return, for each bin, which images show the object from it."""
    own = test.labels == label
    bins = test.bins if test.bins.ndim == 2 else test.bins[:, None].expand_as(test.labels)
    known = own & (bins >= 0)
    count = int(bins.max()) + 1 if bins.numel() else 0
    shown = torch.zeros(len(test), max(count, 0), dtype=torch.bool)
    image, box = known.nonzero(as_tuple=True)
    shown[image, bins[image, box]] = True
    return shown
