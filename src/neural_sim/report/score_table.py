"""Scores of detectors over seeds, classes and test images: the one place that computes means, intervals and leads.

All detectors of a seed are scored on one test set, so that comparisons are paired, by seed and by image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from neural_sim.report.bootstrap import Outcomes, class_scores, mean_of_known
from neural_sim.report.intervals import Estimate, Sample, over_seeds_and_images, ratio


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
        """Return a detector's score of every class, the mean over seeds."""
        means = self.point[self.detectors.index(detector)].mean(0)
        return dict(zip(self.classes, means.tolist(), strict=True))

    def scatter(self) -> Scatter:
        """Return the scatter of one detector's mean score over classes; needs at least two seeds."""
        point, spread = mean_of_known(self.point), mean_of_known(self.spread)
        between, over_images = point.var(1, ddof=1).mean(), np.nanvar(spread, 0, ddof=1).mean()
        return Scatter(float(np.sqrt(between)), float(np.sqrt(over_images)))


def _minus(a: Sample, b: Sample) -> Sample:
    return a[0] - b[0], a[1] - b[1]
