"""Detectors that were trained several times on the same distributions: how far their scores scatter, and which
differences exceed that.

The test images are the same in all trainings. Intervals (:mod:`neural_sim.report.intervals`) are over both, and
differences are paired, training by training and image by image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import Outcomes, class_scores, mean_of_known
from neural_sim.report.compare import points
from neural_sim.report.intervals import Estimate, over_seeds_and_images
from neural_sim.report.page.verdict import Gain, verdict


@dataclass(frozen=True)
class Repeated:
    """Scores of some classes, called ``names`` and by their mean, as fractions.

    ``scores`` are those of every training by distribution (ns, learned, matched), ``mean`` their means with 95 %
    intervals, ``ahead`` the differences (first, second) of the means; ``between`` is the standard deviation between
    trainings of one distribution, over all distributions, and ``over_images`` the standard error of one over images.
    """

    names: tuple[str, ...]
    scores: Mapping[str, Sequence[float]]
    mean: Mapping[str, Estimate]
    ahead: Mapping[tuple[str, str], Estimate]
    between: float
    over_images: float

    @property
    def gain(self) -> Gain:
        """As a run's page has it, with these intervals."""
        room = self.ahead.get(("matched", "ns"))
        means = {which: estimate.value for which, estimate in self.mean.items()}
        return Gain(self.names, means, self.ahead["learned", "ns"], room)


SHOWN = (("learned", "ns"), ("matched", "learned"))
DIFFERENCES = (*SHOWN, ("matched", "ns"))


def repeated(
    matches: Mapping[str, Sequence[Sequence[Outcomes]]],
    groups: Sequence[tuple[Sequence[str], Sequence[int]]],
    draws: int,
    seed: int = 0,
) -> list[Repeated]:
    """Of every group, the names of some classes and their labels.

    Args:
        matches: [training][class] of each distribution, two trainings or more; training k of all distributions has the
            same random numbers.
        groups: classes whose mean counts.
        draws: of the bootstrap over images.
        seed: of the bootstrap.

    Raises:
        ValueError: fewer than two trainings, or different numbers.
    """
    which = list(matches)
    trainings = {len(rows) for rows in matches.values()}
    if len(trainings) != 1 or min(trainings) < 2:
        raise ValueError(f"repeat: want two trainings or more of each distribution, got {sorted(trainings)}")

    point, spread = class_scores(list(matches.values()), draws, seed)
    return [
        _of_group(names, which, point[..., list(labels)], spread[..., list(labels)])
        for names, labels in groups
    ]


def _of_group(
    names: Sequence[str],
    which: Sequence[str],
    point: Float[np.ndarray, "which trainings classes"],
    spread: Float[np.ndarray, "draws which trainings classes"],
) -> Repeated:
    own, resampled = mean_of_known(point), mean_of_known(spread)
    place = {w: i for i, w in enumerate(which)}
    mean = {w: over_seeds_and_images(own[i], resampled[:, i]).as_fraction for w, i in place.items()}
    ahead = {
        (a, b): over_seeds_and_images(
            own[place[a]] - own[place[b]], resampled[:, place[a]] - resampled[:, place[b]]
        )
        for a, b in DIFFERENCES
        if a in place and b in place
    }
    return Repeated(
        tuple(names), {w: own[i].tolist() for w, i in place.items()}, mean, ahead,
        float(np.sqrt(own.var(1, ddof=1).mean())), float(np.sqrt(np.nanvar(resampled, 0, ddof=1).mean())),
    )  # fmt: skip


def sentence(found: Repeated, score: Score) -> str:
    """The verdict on the learned distribution, after as many trainings."""
    trainings = len(found.scores["ns"])
    return f"After {trainings} trainings of each distribution: {verdict(found.gain, score, trainings)}"


def table(found: Sequence[Repeated], score: Score) -> str:
    """Markdown: a row a group, in points. Differences in bold are those whose interval leaves 0 out."""
    first = found[0]
    differences = [pair for pair in SHOWN if pair in first.ahead]
    head = [
        "",
        *first.mean,
        *(f"{a} ahead of {b} by" for a, b in differences),
        "one training's scatter",
        "over images",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for group in found:
        name = group.names[0] if len(group.names) == 1 else "mean of " + ", ".join(group.names)
        cells = [points(group.mean[w]) for w in group.mean]
        cells += [points(group.ahead[pair], sure=True) for pair in differences]
        cells += [f"{100 * group.between:.1f}", f"{100 * group.over_images:.1f}"]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    count = len(first.scores["ns"])
    lines += [
        "",
        f"{score[0].upper()}{score[1:]} on the test set in points, means of {count} trainings, with 95 % intervals "
        "over trainings and test images. Differences in bold leave 0 out. The last two columns are standard "
        "deviations of one detector's score: between trainings on one distribution, and over test images.",
    ]
    return "\n".join(lines)
