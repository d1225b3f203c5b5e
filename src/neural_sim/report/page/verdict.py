"""Whether a run worked, as numbers with intervals and in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.protocol import Score
from neural_sim.report.bootstrap import class_scores, match, mean_of_known
from neural_sim.report.intervals import Estimate, over_images
from neural_sim.types import LabelledImages

Outcome = Literal["better", "worse", "no difference"]
WHICH: tuple[str, ...] = ("ns", "learned", "matched")
PERCENT = 100.0
POINTS: dict[Score, str] = {"AP": "AP", "accuracy": "points of accuracy"}
"""The unit of a score in a sentence."""


@dataclass(frozen=True)
class Gain:
    """AP (or accuracy) of a set of classes, as fractions.

    ``gain`` is learned minus ns, ``room`` matched minus ns, both with 95 % intervals.
    ``room`` is None where matched and ns are one distribution, and where matched is not known.
    """

    names: tuple[str, ...]
    ap: Mapping[str, float]
    gain: Estimate
    room: Estimate | None

    @property
    def outcome(self) -> Outcome:
        """What the interval of the gain allows to say."""
        if not self.gain.certain:
            return "no difference"
        return "better" if self.gain.value > 0.0 else "worse"

    @property
    def closed(self) -> float | None:
        """Fraction of the room that the gain fills; None where the room's interval includes 0."""
        if self.room is None or not self.room.certain or self.room.value <= 0.0:
            return None
        return self.gain.value / self.room.value


@dataclass(frozen=True)
class Resampled:
    """AP (or accuracy) of every class by the detections of ns, learned and matched on one test set, and under resampled
    images; without matched where the target's distribution is not known.

    ``point`` is [which, classes], ``spread`` [draws, which, classes]; nan for a class without a box.
    """

    which: tuple[str, ...]
    point: Float[np.ndarray, "which classes"]
    spread: Float[np.ndarray, "draws which classes"]

    @staticmethod
    def of(
        detections: Mapping[str, Sequence[Mapping[str, Tensor]]],
        test: LabelledImages,
        classes: int,
        draws: int = 200,
        score: Score = "AP",
    ) -> Resampled:
        """All classes and detectors under the same resampled images."""
        known = tuple(which for which in WHICH if which in detections)
        matches = [
            [match(detections[which], test, label, score) for label in range(classes)] for which in known
        ]
        point, spread = class_scores([matches], draws)
        return Resampled(known, point[0], spread[:, 0])

    @property
    def present(self) -> list[int]:
        """Labels of the classes that the test set shows."""
        return np.flatnonzero(~np.isnan(self.point[0])).tolist()

    def gain(self, names: Sequence[str], labels: Sequence[int], same_target: bool) -> Gain:
        """Of the classes ``labels``, called ``names``; draws without a box of a class leave it out. ``same_target``:
        the target's distribution is the initial one.
        """
        point, spread = (mean_of_known(part[..., list(labels)]) for part in (self.point, self.spread))
        gain, *room = (
            over_images(float(point[i] - point[0]), spread[:, i] - spread[:, 0]) for i in range(1, len(point))
        )
        ap = dict(zip(self.which, point.tolist(), strict=True))
        return Gain(tuple(names), ap, gain, None if same_target or not room else room[0])


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them: ``a, b and c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def interval(estimate: Estimate) -> str:
    """Bounds in points of AP: ``20.1 to 27.3``."""
    if estimate.low is None or estimate.high is None:
        return "no interval"
    return f"{PERCENT * estimate.low:.1f} to {PERCENT * estimate.high:.1f}"


def negated(estimate: Estimate) -> Estimate:
    """Minus the value, with its interval."""
    low, high = (None if bound is None else -bound for bound in (estimate.high, estimate.low))
    return Estimate(-estimate.value, low, high)


def verdict(gain: Gain | None, score: Score = "AP", trainings: int = 1) -> str:
    """One sentence for the top of the page; ``score`` is what ``gain`` is of.

    Whether it worked is said of several trainings alone. The interval of one is over test images, and trainings on
    distributions that are as good as each other often differ by more.
    """
    if gain is None:
        return "The detectors were not scored on test images, so whether it worked is not known."
    points, bounds, who = PERCENT * gain.gain.value, interval(gain.gain), listed(gain.names)
    change = f"{abs(points):.1f} {POINTS[score]}"
    reached = f"{PERCENT * gain.ap['ns']:.1f} to {PERCENT * gain.ap['learned']:.1f}"
    one = "In one training of each, the learned distribution gave"
    if gain.outcome == "better":
        several = "It worked: training on the learned distribution gives"
        text = f"{several if trainings > 1 else one} {change} more on {who}"
        over = bounds if trainings > 1 else f"{bounds} over test images"
        return f"{text} ({over}), from {reached}{_of_the_room(gain)}."
    if gain.outcome == "worse":
        bounds = interval(negated(gain.gain))
        if trainings == 1:
            return f"{one} {change} less on {who} ({bounds} over test images)."
        return (
            f"It made things worse: training on the learned distribution costs {change} on {who} ({bounds})."
        )
    changes = f"changes the {score} of {who} by {points:+.1f}"
    text = f"No difference can be told: the learned distribution {changes} ({bounds})"
    return f"{text}{_of_the_room(gain)}."


def _of_the_room(gain: Gain) -> str:
    if gain.room is None:
        return ""
    if gain.closed is None:
        return f"; the target's own distribution would give {PERCENT * gain.room.value:+.1f} ({interval(gain.room)})"
    return f", {gain.closed:.0%} of what the target's own distribution would give"
