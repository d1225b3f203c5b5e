"""The settings of an experiment that were run, each with its runs and their scores, scored in the newest way."""

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
many photographs are trained on, and how."""
MEAN = "mAP"
"""Name under which the mean over biased objects is listed with the objects."""
CALLED = {"ns": "NS", "matched": "matched", "neural_sim": "NSO", "auto_sim": "Auto-Sim", "lts": "LTS"}


def called(method: str) -> str:
    """Return the paper's name of a method, or our own."""
    return CALLED.get(method, method)


@dataclass(frozen=True)
class Setting:
    """One start and target of an experiment, with the runs of all methods and seeds and their scores.

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
        """Score the runs of a group; ``draws`` and ``seed`` are those of the bootstrap."""
        return Setting(group, reference, score_table(group.runs, reference, draws, seed))

    @property
    def first(self) -> FinishedRun:
        """One of the runs, to read what all have in common."""
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
        """The detectors in order, from ns to matched, the upper bound; the reference is the last that learns."""
        learned = [name for name in self.table.detectors if name not in (*BOUNDS, *WITHOUT, self.reference)]
        order = ["ns", *sorted(learned, reverse=True), self.reference, "matched"]
        return [name for name in order if name in self.table.detectors]

    @property
    def columns(self) -> list[str]:
        """The detectors, including, if photographs train, those without synthetic images or without photographs."""
        return [*self.methods, *(name for name in WITHOUT if name in self.table.detectors)]

    @property
    def commits(self) -> list[str]:
        """Code commits of the runs."""
        return sorted({run.results.get("commit") or UNKNOWN for run in self.group.runs})

    @property
    def of_reference(self) -> list[Mapping[str, Any]]:
        """results.json of each run of the reference method, one per seed."""
        return [run.results for run in self.group.runs if run.method == self.reference]

    def score(self, method: str, name: str = MEAN) -> Estimate:
        """Return the score of a detector on an object, or its mean over objects."""
        return self._of(name).mean(method)

    def ahead(self, method: str, name: str = MEAN) -> Estimate:
        """Return the score of the reference minus that of a method."""
        return self._of(name).ahead(self.reference, method)

    def _of(self, name: str) -> ScoreTable:
        return self.table if name == MEAN else self.table.of_classes([name])

    def verdict(self, name: str = MEAN) -> str:
        """Give the score of the reference and its lead over each method, in words."""
        ours = points(self.score(self.reference, name))
        others = [method for method in self.methods if method not in (self.reference, "matched")]
        ahead = [f"{called(method)} by {points(self.ahead(method, name))}" for method in others]
        return f"NSO {ours}; ahead of {', '.join(ahead)}"

    def distribution(self, which: str, name: str, factor: str) -> list[float]:
        """Return the ``initial`` or ``target`` distribution of an object."""
        return self.first.results["psi"][name][factor][which]

    def factors(self, name: str) -> list[str]:
        """Return the factors that are learned for an object."""
        return list(self.first.results["psi"][name])


@dataclass(frozen=True)
class Settings:
    """Read the settings of experiments from MLflow.

    Args:
        uri: address of the MLflow store.
        budget: ``budget`` (scale) that runs must have in their configuration.
        reference: the method that the others are compared with.
        draws: number of bootstrap draws.
        seed: seed of the bootstrap.
    """

    uri: str
    budget: Mapping[str, Any]
    reference: str
    draws: int
    seed: int

    def read(self, experiments: Sequence[str]) -> tuple[list[Setting], list[LeftOut]]:
        """Return the settings of experiments, and the runs that are left out.

        Settings are ordered by experiment, then by first run. An experiment without runs has none.
        """
        known = tracking.experiments(self.uri)
        groups, left_out = self.groups(Runs.read(self.uri, [name for name in experiments if name in known]))
        groups.sort(key=lambda group: experiments.index(group.runs[0].experiment))
        return [Setting.of(group, self.reference, self.draws, self.seed) for group in groups], left_out

    def groups(self, runs: Runs) -> tuple[list[Group], list[LeftOut]]:
        """Return groups of runs to compare; if an experiment was scored in several ways, those scored in the newest."""
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
            return True  # such runs are left out for another reason
        return at_scale(run.results.get("config", {}).get("budget") or {}, self.budget)


def _way(run: FinishedRun) -> str:
    """Return a digest of everything that scores depend on, except what an experiment varies."""
    values = scored_values(run.results)
    return digest({key: value for key, value in values.items() if not AXES.match(key)})


def modes(p: Sequence[float]) -> str:
    """Abbreviate a distribution: the bins, from 1, with more than an equal share, or ``uniform``."""
    more = [str(bin) for bin, value in enumerate(p, 1) if value * len(p) > 1.05]
    return ", ".join(more) or "uniform"
