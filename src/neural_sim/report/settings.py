"""Settings of an experiment that were run: for each, its runs and its scores, of the newest way of scoring."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neural_sim.digests import digest
from neural_sim.report import logged
from neural_sim.report.finished import Candidate, FinishedRun, candidates, read_run
from neural_sim.report.identity import at_scale, scored_values
from neural_sim.report.object_scores import ObjectScores, object_scores
from neural_sim.report.selection import Group, LeftOut, Selection
from neural_sim.report.tracking import UNKNOWN

AXES = re.compile(r"parameter\.\w+\.(gap|biased)\b|training\.real\.(mode|count|fraction)$")
"""Keys of a configuration in which the settings of one experiment differ: starts and targets of biased objects, and how
many photographs train, and how."""


@dataclass(frozen=True)
class Setting:
    """One start and target of an experiment: its runs of all methods and seeds, and what they score."""

    group: Group
    runs: Sequence[FinishedRun]
    scores: ObjectScores

    @property
    def experiment(self) -> str:
        return self.runs[0].results["experiment"]

    @property
    def gap(self) -> str:
        return self.runs[0].results["gap"]

    @property
    def commits(self) -> list[str]:
        """Of the code of its runs."""
        return sorted({run.results.get("commit") or UNKNOWN for run in self.runs})

    @property
    def of_reference(self) -> list[Mapping[str, Any]]:
        """results.json of the reference method's runs, a seed each."""
        return [run.results for run in self.runs if run.method == self.scores.reference]

    def distribution(self, which: str, name: str, factor: str) -> list[float]:
        """The ``initial`` or ``target`` distribution of an object."""
        return self.runs[0].results["psi"][name][factor][which]

    def factors(self, name: str) -> list[str]:
        """What is learned of an object."""
        return list(self.runs[0].results["psi"][name])


@dataclass(frozen=True)
class Settings:
    """Reads the settings of experiments from MLflow.

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
        """The settings of ``experiments`` in their order, those of each as they were run first; and runs that are left
        out. An experiment without runs has no settings.
        """
        groups, left_out = self.groups(experiments)
        settings = []
        for group in sorted(groups, key=lambda g: experiments.index(g.runs[0].experiment)):
            runs = [read_run(run) for run in group.runs]
            scores = object_scores(runs, self.reference, self.draws, self.seed)
            settings.append(Setting(group, runs, scores))
        return settings, left_out

    def groups(self, experiments: Sequence[str]) -> tuple[list[Group], list[LeftOut]]:
        """Runs to compare, as :class:`Selection` has them; where an experiment was scored in several ways, those of the
        newest.
        """
        known = logged.experiments(self.uri)
        found = candidates(self.uri, [name for name in experiments if name in known])
        right = [run for run in found if run.unusable or self._at_scale(run)]
        others = [_left(run, "it was run at another scale") for run in found if run not in right]
        selection = Selection(right, self.reference)
        newest: dict[str, str] = {}
        for run in right:
            if run.unusable is None and run.method == self.reference and run.results.get("scoring"):
                newest.setdefault(run.experiment, _way(run))
        groups = [g for g in selection.groups if _way(g.runs[0]) == newest[g.runs[0].experiment]]
        older = [run for g in selection.groups if g not in groups for run in g.runs]
        reason = "newer runs of the experiment are scored in another way"
        return groups, [*others, *selection.left_out, *(_left(run, reason) for run in older)]

    def _at_scale(self, run: Candidate) -> bool:
        return at_scale(run.results.get("config", {}).get("budget") or {}, self.budget)


def _way(run: Candidate) -> str:
    """A digest of all that AP depends on but what an experiment varies."""
    values = scored_values(run.results)
    return digest({key: value for key, value in values.items() if not AXES.match(key)})


def _left(run: Candidate, reason: str) -> LeftOut:
    return LeftOut(run.name, run.run_id, run.experiment, reason)


def modes(p: Sequence[float]) -> str:
    """A distribution over bins in short: its bins, from 1, that have more than an equal part, or ``uniform``."""
    more = [str(bin) for bin, value in enumerate(p, 1) if value * len(p) > 1.05]
    return ", ".join(more) or "uniform"
