"""AP of each biased object for every method of a group of finished runs, and how far the reference is ahead on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from neural_sim.report.bootstrap import Outcomes, class_scores, mean_of_known
from neural_sim.report.finished import FinishedRun
from neural_sim.report.intervals import Estimate, over_seeds_and_images
from neural_sim.report.statistics import BOUNDS, FIXED

MEAN = "mAP"
"""The name of the mean over the biased objects among them."""
CALLED = {"ns": "NS", "matched": "matched", "neural_sim": "NSO", "auto_sim": "Auto-Sim", "lts": "LTS"}
"""The paper's names of methods."""
WITHOUT = ("synthetic_only", "real_only", "views_only")
"""Detectors that are scored where photographs train too: on synthetic images alone, on photographs alone, and on the
views of the fields alone."""


def called(method: str) -> str:
    """The paper's name of a method, or our own."""
    return CALLED.get(method, method)


@dataclass(frozen=True)
class ObjectScores:
    """``ap`` and ``ahead`` map a method, then an object or ``MEAN``, to an estimate in [0, 1]: the AP (0.50 to 0.95) on
    the test set, and the reference's AP minus the method's. ``methods`` begin with ns and end with matched, the
    detectors trained on the initial and on the target's distribution, if that is known. Where photographs train too,
    ``ap`` also has ``WITHOUT``, of the reference's runs.
    """

    reference: str
    methods: tuple[str, ...]
    objects: tuple[str, ...]
    seeds: tuple[int, ...]
    ap: Mapping[str, Mapping[str, Estimate]]
    ahead: Mapping[str, Mapping[str, Estimate]]

    @property
    def rows(self) -> tuple[str, ...]:
        """The objects, then ``MEAN``."""
        return (*self.objects, MEAN)


def object_scores(runs: Sequence[FinishedRun], reference: str, draws: int, seed: int = 0) -> ObjectScores:
    """Of the runs of one group: one of each method at each seed, on equal test images.

    Methods of a seed share its test images, so that differences are paired.

    Raises:
        ValueError: a method that lacks a seed of another.
    """
    table = {(run.method, run.seed): run for run in runs}
    learned = [reference, *sorted({run.method for run in runs} - {reference, *FIXED})]
    seeds = tuple(sorted({run.seed for run in runs}))
    missing = [f"{m} seed {s}" for m in learned for s in seeds if (m, s) not in table]
    if missing:
        raise ValueError(f"scores of {reference}: want a run of each method at each seed, lacking {missing}")
    bounds = [bound for bound in BOUNDS if all(bound in table[reference, at].matches for at in seeds)]
    methods = (bounds[0], *reversed(learned), *bounds[1:])
    objects = tuple(runs[0].results["biased"])
    columns = (*methods, *(w for w in WITHOUT if all(w in table[reference, at].matches for at in seeds)))
    matches = [[_matches(table, reference, column, at) for column in columns] for at in seeds]
    point, spread = (_with_mean(scores) for scores in class_scores(matches, draws, seed))
    rows, ours = (*objects, MEAN), columns.index(reference)

    def named(
        values: Float[np.ndarray, "seeds rows"], resampled: Float[np.ndarray, "draws seeds rows"]
    ) -> dict[str, Estimate]:
        return {name: over_seeds_and_images(values[:, i], resampled[..., i]) for i, name in enumerate(rows)}

    of = [(point[:, i], spread[..., i, :]) for i in range(len(columns))]
    ap = {c: {n: e.as_fraction for n, e in named(*of[i]).items()} for i, c in enumerate(columns)}
    ahead = {
        m: named(of[ours][0] - of[i][0], of[ours][1] - of[i][1]) for i, m in enumerate(methods) if i != ours
    }
    return ObjectScores(reference, methods, objects, seeds, ap, ahead)


def _matches(
    table: Mapping[tuple[str, int], FinishedRun], reference: str, method: str, seed: int
) -> Sequence[Outcomes]:
    """Of a method's detector at a seed. The reference's run stands for ns and matched, which all methods share, and for
    ``WITHOUT``.
    """
    if method in BOUNDS or method in WITHOUT:
        return table[reference, seed].matches[method]
    return table[method, seed].matches["learned"]


def _with_mean(scores: Float[np.ndarray, "*n objects"]) -> Float[np.ndarray, "*n rows"]:
    """With the mean over objects as a last one; an object without a box stays out of it."""
    return np.concatenate([scores, mean_of_known(scores)[..., None]], -1)
