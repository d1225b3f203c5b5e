"""Settings of an experiment that were run: for each, its runs and its scores, of the newest way of scoring."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from neural_sim.digests import digest
from neural_sim.report import tracking
from neural_sim.report.identity import at_scale, scored_values
from neural_sim.report.intervals import Estimate, points
from neural_sim.report.runs import BOUNDS, WITHOUT, FinishedRun, Group, LeftOut, Runs, score_table, select
from neural_sim.report.score_table import ScoreTable
from neural_sim.report.tracking import UNKNOWN

AXES = re.compile(r"parameter\.\w+\.(gap|biased)\b|training\.real\.(mode|count|fraction)$")
"""Keys of a configuration in which the settings of one experiment differ: starts and targets of biased objects, and how
many photographs train, and how."""
MEAN = "mAP"
"""The name of the mean over the biased objects among them."""
CALLED = {"ns": "NS", "matched": "matched", "neural_sim": "NSO", "auto_sim": "Auto-Sim", "lts": "LTS"}


def called(method: str) -> str:
    """Return the paper's name of a method, or our own."""
    return CALLED.get(method, method)


@dataclass(frozen=True)
class Setting:
    """One start and target of an experiment: its runs of all methods and seeds, and what they score.

    Args:
        group: the runs.
        reference: the method that the others are compared with.
        table: scores of the biased objects.
    """

    group: Group
    reference: str
    table: ScoreTable

    @staticmethod
    def of(group: Group, reference: str, draws: int, seed: int = 0) -> Setting:
        """Score the runs of a group; ``draws`` and ``seed`` are of the bootstrap."""
        return Setting(group, reference, score_table(group.runs, reference, draws, seed))

    @property
    def first(self) -> FinishedRun:
        """A run, for what all have in common."""
        return self.group.runs[0]

    @property
    def experiment(self) -> str:
        """The experiment of its runs."""
        return self.first.results["experiment"]

    @property
    def gap(self) -> str:
        """The kind of start: same, uniform or disjoint."""
        return self.first.results["gap"]

    @property
    def seeds(self) -> str:
        """The seeds that all methods have, as text."""
        return ", ".join(map(str, self.group.seeds))

    @property
    def objects(self) -> tuple[str, ...]:
        """The biased objects."""
        return self.table.classes

    @cached_property
    def methods(self) -> list[str]:
        """The detectors, from ns to matched, the upper bound; the reference is the last that learns."""
        learned = [name for name in self.table.detectors if name not in (*BOUNDS, *WITHOUT, self.reference)]
        order = ["ns", *sorted(learned, reverse=True), self.reference, "matched"]
        return [name for name in order if name in self.table.detectors]

    @property
    def columns(self) -> list[str]:
        """The detectors, and where photographs train those without synthetic images or without photographs."""
        return [*self.methods, *(name for name in WITHOUT if name in self.table.detectors)]

    @property
    def commits(self) -> list[str]:
        """The commits of the code of its runs."""
        return sorted({run.results.get("commit") or UNKNOWN for run in self.group.runs})

    @property
    def of_reference(self) -> list[Mapping[str, Any]]:
        """results.json of the reference method's runs, a seed each."""
        return [run.results for run in self.group.runs if run.method == self.reference]

    def score(self, method: str, name: str = MEAN) -> Estimate:
        """Return a detector's score of an object, or the mean over objects."""
        return self._of(name).mean(method)

    def ahead(self, method: str, name: str = MEAN) -> Estimate:
        """Return the reference's score minus a method's."""
        return self._of(name).ahead(self.reference, method)

    def _of(self, name: str) -> ScoreTable:
        return self.table if name == MEAN else self.table.of_classes([name])

    def verdict(self, name: str = MEAN) -> str:
        """Say what the reference scores, and by how much it is ahead of each method."""
        ours = points(self.score(self.reference, name))
        others = [method for method in self.methods if method not in (self.reference, "matched")]
        ahead = [f"{called(method)} by {points(self.ahead(method, name))}" for method in others]
        return f"NSO {ours}; ahead of {', '.join(ahead)}"

    def distribution(self, which: str, name: str, factor: str) -> list[float]:
        """Return the ``initial`` or ``target`` distribution of an object."""
        return self.first.results["psi"][name][factor][which]

    def factors(self, name: str) -> list[str]:
        """Return what is learned of an object."""
        return list(self.first.results["psi"][name])


@dataclass(frozen=True)
class Settings:
    """Read the settings of experiments from MLflow.

    Args:
        uri: of the MLflow store.
        budget: the ``budget`` of the configuration that runs must have: the scale.
        reference: the method that the others are compared with.
        draws: of the bootstrap.
        seed: of the bootstrap.
    """

    uri: str
    budget: Mapping[str, Any]
    reference: str
    draws: int
    seed: int

    def read(self, experiments: Sequence[str]) -> tuple[list[Setting], list[LeftOut]]:
        """Return the settings of experiments in their order, those of each as they were run first, and runs left out.

        An experiment without runs has no settings.
        """
        known = tracking.experiments(self.uri)
        groups, left_out = self.groups(Runs.read(self.uri, [name for name in experiments if name in known]))
        groups.sort(key=lambda group: experiments.index(group.runs[0].experiment))
        return [Setting.of(group, self.reference, self.draws, self.seed) for group in groups], left_out

    def groups(self, runs: Runs) -> tuple[list[Group], list[LeftOut]]:
        """Return groups of runs to compare; of an experiment that was scored in several ways, those of the newest."""
        right = runs.without(lambda run: None if self._at_scale(run) else "it was run at another scale")
        found, left_out = select(right, self.reference)
        newest: dict[str, str] = {}
        for run in right.rows:
            if run.unusable is None and run.method == self.reference and run.results.get("scoring"):
                newest.setdefault(run.experiment, _way(run))
        groups = [group for group in found if _way(group.runs[0]) == newest[group.runs[0].experiment]]
        older = [run for group in found if group not in groups for run in group.runs]
        reason = "newer runs of the experiment are scored in another way"
        return groups, [*left_out, *(LeftOut.of(run, reason) for run in older)]

    def _at_scale(self, run: FinishedRun) -> bool:
        if run.unusable is not None:
            return True  # left out for that
        return at_scale(run.results.get("config", {}).get("budget") or {}, self.budget)


def _way(run: FinishedRun) -> str:
    """Return a digest of all that scores depend on but what an experiment varies."""
    values = scored_values(run.results)
    return digest({key: value for key, value in values.items() if not AXES.match(key)})


def modes(p: Sequence[float]) -> str:
    """Write a distribution in short: its bins, from 1, that have more than an equal part, or ``uniform``."""
    more = [str(bin) for bin, value in enumerate(p, 1) if value * len(p) > 1.05]
    return ", ".join(more) or "uniform"
