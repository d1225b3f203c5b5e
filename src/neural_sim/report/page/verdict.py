"""Judge whether a run worked, by numbers with intervals and in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from neural_sim.detector.protocol import Score
from neural_sim.report.intervals import Estimate, bounds
from neural_sim.report.score_table import ScoreTable

Outcome = Literal["better", "worse", "no difference"]
PERCENT = 100.0
POINTS: dict[Score, str] = {"AP": "AP", "accuracy": "points of accuracy"}
"""The unit of a score in a sentence."""


@dataclass(frozen=True)
class Gain:
    """AP (or accuracy) of a set of classes, as fractions.

    Args:
        names: names of the classes.
        ap: scores of the detectors ns, learned and, if the target's distribution is known, matched.
        gain: learned minus ns, with its 95 % interval.
        room: matched minus ns; None if both distributions are the same, or matched is not known.
    """

    names: tuple[str, ...]
    ap: Mapping[str, float]
    gain: Estimate
    room: Estimate | None

    @staticmethod
    def of(table: ScoreTable, same_target: bool = False) -> Gain:
        """Read the gain of a table's classes.

        Args:
            table: scores of the detectors ns, learned and perhaps matched.
            same_target: whether the target's distribution is the initial one.
        """
        known = "matched" in table.detectors and not same_target
        ap = {which: table.mean(which).value for which in table.detectors}
        room = table.ahead("matched", "ns") if known else None
        return Gain(table.classes, ap, table.ahead("learned", "ns"), room)

    @property
    def outcome(self) -> Outcome:
        """The conclusion that the interval of the gain allows."""
        if not self.gain.certain:
            return "no difference"
        return "better" if self.gain.value > 0.0 else "worse"

    @property
    def closed(self) -> float | None:
        """Fraction of the room that the gain fills; None if the room's interval includes 0."""
        if self.room is None or not self.room.certain or self.room.value <= 0.0:
            return None
        return self.gain.value / self.room.value


def listed(names: Sequence[str]) -> str:
    """Write names as in a sentence: ``a, b and c``."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def verdict(gain: Gain | None, score: Score = "AP", trainings: int = 1, images: str = "test images") -> str:
    """Say in one sentence whether the run worked.

    Only several trainings can show that it worked. The interval for one training is over test images, and trainings on
    equally good distributions often differ by more.

    Args:
        gain: the gain; None if no detector was scored.
        score: the kind of score.
        trainings: number of trainings on each distribution.
        images: kind of images that were scored.
    """
    if gain is None:
        return f"The detectors were not scored on {images}, so whether it worked is not known."
    points, reach, who = PERCENT * gain.gain.value, bounds(gain.gain), listed(gain.names)
    change = f"{abs(points):.1f} {POINTS[score]}"
    reached = f"{PERCENT * gain.ap['ns']:.1f} to {PERCENT * gain.ap['learned']:.1f}"
    one = "With one training on each distribution, the learned one gave"
    if gain.outcome == "better":
        several = "It worked: training on the learned distribution gives"
        text = f"{several if trainings > 1 else one} {change} more on {who}"
        over = reach if trainings > 1 else f"{reach} over {images}"
        return f"{text} ({over}), from {reached}{_of_the_room(gain)}."
    if gain.outcome == "worse":
        reach = bounds(gain.gain.negated)
        if trainings == 1:
            return f"{one} {change} less on {who} ({reach} over {images})."
        return (
            f"It made things worse: training on the learned distribution costs {change} on {who} ({reach})."
        )
    changes = f"changes the {score} of {who} by {points:+z.1f}"
    text = f"No difference can be seen on {images}: the learned distribution {changes} ({reach})"
    return f"{text}{_of_the_room(gain)}."


def _of_the_room(gain: Gain) -> str:
    if gain.room is None:
        return ""
    if gain.closed is None:
        return f"; the target's own distribution would give {PERCENT * gain.room.value:+z.1f} ({bounds(gain.room)})"
    return f", {gain.closed:.0%} of what the target's own distribution would give"
