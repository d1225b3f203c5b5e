"""Read finished runs from MLflow, and group those that are comparable; the others are left out with a reason.

Scores are comparable between runs with the same scoring (``scoring``) and, for each seed, the same test images
(``test_set``). Seeds may be averaged if a method ran with the same settings for all of them (``configuration``). The
three are digests in results.json, see ``identity``.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from neural_sim.detector.protocol import Score
from neural_sim.documents import read_json
from neural_sim.report import tracking
from neural_sim.report.detections import DETECTIONS, read_detections
from neural_sim.report.identity import KEYS, all_values, differences, headings, scored_values
from neural_sim.report.score_table import Outcomes, ScoreTable, match

BOUNDS = ("ns", "matched")
"""Detectors that every run has, whatever its method: trained on the initial distribution and, if known, on the
target's. They stand for the methods in ``FIXED``, whose own runs are not compared."""
FIXED = ("ns", "oracle")
WITHOUT = ("synthetic_only", "real_only", "views_only")
"""Detectors that are scored as well if training uses photographs: trained on synthetic images alone, on photographs
alone, and on the views of the fields alone."""
RESULTS = "results.json"

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run: the content of its results.json, and its detections, which are read on demand.

    Args:
        results: the content of results.json, empty if the run is unusable.
        name: name of the run in MLflow.
        run_id: id of the run in MLflow.
        experiment: experiment of the run in MLflow.
        read: reads ``outcomes``.
        unusable: why the run cannot be compared; None: it can.
    """

    results: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    run_id: str = ""
    experiment: str = ""
    read: Callable[[], Mapping[str, Sequence[Outcomes]]] = dict
    unusable: str | None = None

    @cached_property
    def outcomes(self) -> Mapping[str, Sequence[Outcomes]]:
        """The outcomes from which its biased objects are scored, for each of its detectors (ns, learned, ...)."""
        return self.read()

    @property
    def method(self) -> str:
        """The method that chose the training images."""
        return self.results["method"]

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self.results["seed"]

    @property
    def score(self) -> Score:
        """The kind of score; versions without classifiers did not record it."""
        return self.results.get("score", "AP")

    @property
    def setting(self) -> str:
        """The experiment, with its gap unless that is the experiment's own."""
        gap = self.results["gap"]
        return self.results["experiment"] + ("" if gap == "disjoint" else f", {gap}")

    @property
    def label(self) -> str:
        """Its name and the first digits of its id."""
        return f"{self.name} ({self.run_id[:8]})"

    def spent(self, key: str) -> float:
        """Return the method's total cost: images, detector_steps, products, seconds or cpu_seconds."""
        return float(self.results["curve"][-1][key])

    def detector(self, name: str) -> Sequence[Outcomes]:
        """Return the outcomes of a detector by its name in a table; a method's name means its ``learned``."""
        return self.outcomes[name if name in (*BOUNDS, *WITHOUT) else "learned"]


@dataclass(frozen=True)
class LeftOut:
    """A run that a comparison does not use, and the reason."""

    run: str
    run_id: str
    experiment: str
    reason: str

    @staticmethod
    def of(run: FinishedRun, reason: str) -> LeftOut:
        """Leave out a run for a reason."""
        return LeftOut(run.name, run.run_id, run.experiment, reason)

    @property
    def label(self) -> str:
        """Its name and the first digits of its id."""
        return f"{self.run} ({self.run_id[:8]})"


@dataclass(frozen=True)
class Runs:
    """The rows of a table in order, and the runs that rules have left out of it.

    Args:
        rows: the runs, newest first within each experiment.
        left_out: the other runs, in the order in which they were left out.
    """

    rows: tuple[FinishedRun, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    @staticmethod
    def read(uri: str, experiments: Sequence[str]) -> Runs:
        """Read the runs of MLflow experiments.

        Raises:
            ValueError: no such experiment.
        """
        names = dict.fromkeys(experiments)
        return Runs(tuple(_read(run, name) for name in names for run in tracking.logged_runs(uri, name)))

    def without(self, reason: Callable[[FinishedRun], str | None]) -> Runs:
        """Leave out the runs that a rule gives a reason for."""
        reasons = [(run, reason(run)) for run in self.rows]
        kept = tuple(run for run, why in reasons if why is None)
        left = tuple(LeftOut.of(run, why) for run, why in reasons if why is not None)
        return Runs(kept, self.left_out + left)

    def groupby(self, key: Callable[[FinishedRun], Key]) -> dict[Key, Runs]:
        """Group the rows, in the order of the groups' first rows; groups do not include runs left out before."""
        groups: dict[Key, list[FinishedRun]] = {}
        for run in self.rows:
            groups.setdefault(key(run), []).append(run)
        return {value: Runs(tuple(rows)) for value, rows in groups.items()}

    def of(self, method: str) -> tuple[FinishedRun, ...]:
        """Return the rows of a method."""
        return tuple(run for run in self.rows if run.method == method)


@dataclass(frozen=True)
class Group:
    """Runs to compare: one of each method at each of ``seeds``, the reference's first.

    Args:
        setting: the experiment and its gap.
        label: name of the group, unique in a comparison.
        heading: how it differs from other groups of the same setting; empty if there are none.
        runs: the runs; those of one seed have the same test images.
    """

    setting: str
    label: str
    heading: str
    runs: tuple[FinishedRun, ...]

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds that all methods have."""
        return tuple(sorted({run.seed for run in self.runs}))


def score_table(runs: Sequence[FinishedRun], reference: str, draws: int, seed: int = 0) -> ScoreTable:
    """Score the detectors of runs on the biased objects: the bounds, every method, and those of ``WITHOUT``.

    The seeds are those that all methods have. Detectors that all methods share are taken from the reference's runs.

    Args:
        runs: the runs of one group.
        reference: the method that the others are compared with.
        draws: number of bootstrap draws over test images.
        seed: seed of the bootstrap.

    Raises:
        ValueError: the reference has no run, or no seed is common to all methods.
    """
    table = {(run.method, run.seed): run for run in runs}
    if not any(method == reference for method, _ in table):
        raise ValueError(f"compare.reference: no run of {reference!r}, got {sorted({m for m, _ in table})}")
    methods = methods_of(runs, reference)
    seeds = common_seeds(runs, methods)
    if not seeds:
        raise ValueError(f"compare: no seed is common to {', '.join(methods)} in {runs[0].setting}")
    ours = [table[reference, at] for at in seeds]
    shared = [name for name in (*BOUNDS, *WITHOUT) if all(name in run.outcomes for run in ours)]
    outcomes = {name: [run.detector(name) for run in ours] for name in shared}
    outcomes |= {name: [table[name, at].detector(name) for at in seeds] for name in methods}
    return ScoreTable.of(outcomes, runs[0].results["biased"], draws, seed)


def methods_of(runs: Iterable[FinishedRun], reference: str) -> tuple[str, ...]:
    """Return the methods that are compared, the reference first."""
    return (reference, *sorted({run.method for run in runs} - {reference, *FIXED}))


def common_seeds(runs: Iterable[FinishedRun], methods: Sequence[str]) -> tuple[int, ...]:
    """Return the seeds that all methods have, in order."""
    known = {(run.method, run.seed) for run in runs}
    return tuple(sorted({seed for _, seed in known if all((method, seed) in known for method in methods)}))


def by_reason(left_out: Iterable[LeftOut]) -> dict[str, list[str]]:
    """Group the labels of runs by the reason why they were left out."""
    grouped: dict[str, list[str]] = {}
    for run in left_out:
        grouped.setdefault(run.reason, []).append(run.label)
    return grouped


def select(
    runs: Runs, reference: str, methods: Sequence[str] | None = None
) -> tuple[list[Group], tuple[LeftOut, ...]]:
    """Return the groups that can be compared with a reference method, and all runs that are left out.

    Args:
        runs: the runs of all requested experiments, newest first within each.
        reference: the method that the others are compared with.
        methods: the other methods; None: all.
    """
    usable = runs.without(lambda run: _why_unusable(run, reference, methods))
    keyed = usable.groupby(lambda run: (run.setting, run.results["scoring"]))
    anchors = {key: own.of(reference)[:1] for key, own in keyed.items()}
    kept, left = {}, list(usable.left_out)
    for (setting, scoring), own in keyed.items():
        if anchors[setting, scoring]:
            chosen = _comparable(own, reference)
            kept[setting, scoring] = chosen.rows
        else:
            others = [run for (name, _), found in anchors.items() if name == setting for run in found]
            chosen = own.without(lambda run, others=others: _why_no_reference(run, reference, others))
        left += chosen.left_out
    return [group for group in _grouped(kept) if group.runs], tuple(left)


def _read(run: tracking.LoggedRun, experiment: str) -> FinishedRun:
    known = FinishedRun(name=run.name, run_id=run.run_id, experiment=experiment)
    if run.status != "FINISHED":
        return replace(known, unusable=f"its status in MLflow is {run.status}")
    for file in (RESULTS, DETECTIONS):
        if file not in run.files:
            return replace(known, unusable=f"it was not evaluated: it left no {file}")
    try:
        results = read_json(run.fetch(RESULTS))
    except ValueError as error:
        return replace(known, unusable=str(error))
    if not isinstance(results, Mapping):
        return replace(known, unusable=f"its {RESULTS} holds no results of a run")
    return replace(known, results=results, read=lambda: _outcomes(known, results, run.fetch(DETECTIONS)))


def _outcomes(run: FinishedRun, results: Mapping[str, Any], file: Path) -> dict[str, list[Outcomes]]:
    """Match a run's detections in ``file`` to the test set's boxes, for each of its biased objects."""
    names = list(results["psi"])
    try:
        truth, detections = read_detections(file)
        if "learned" not in detections:
            raise ValueError(f"{file}: holds no detections of the learned distribution's detector")
    except ValueError as error:
        raise ValueError(
            f"{run.label} of {run.experiment}: {error}; restore the file or delete the run"
        ) from error
    score: Score = results.get("score", "AP")
    labels = [names.index(name) for name in results["biased"]]
    return {which: [match(own, truth, label, score) for label in labels] for which, own in detections.items()}


def _why_unusable(run: FinishedRun, reference: str, methods: Sequence[str] | None) -> str | None:
    """Return why a run cannot be compared with any other; None if it can."""
    if run.unusable is not None:
        return run.unusable
    if methods is not None and run.method not in (reference, *methods):
        return "compare.methods does not name its method"
    if not all(run.results.get(key) for key in KEYS):
        return "an older version wrote it, without the digests that tell what it can be compared with"
    if not (run.results["biased"] and run.results["curve"]):
        return "all its objects start from the target's distribution"
    if run.method in FIXED and run.method != reference:
        return "every run trains and scores this detector itself, see the rows ns and matched"
    return None


def _why_no_reference(run: FinishedRun, reference: str, anchors: Sequence[FinishedRun]) -> str:
    """Return why a run has nothing to be compared with.

    ``anchors`` are the reference's newest runs of the same setting, which are scored in other ways.
    """
    if not anchors:
        return f"{reference} has no run of this setting"
    differs = differences(scored_values(run.results), scored_values(anchors[0].results))
    return f"no run of {reference} is scored in the same way; compared with {anchors[0].label}, {differs}"


def _comparable(runs: Runs, reference: str) -> Runs:
    """Choose one run of each method at each seed that they have in common, the reference's first."""
    by_method = runs.groupby(lambda run: run.method)
    order = sorted(by_method, key=lambda method: (method != reference, method))
    alike = {method: _of_one_configuration(by_method[method]) for method in order}
    left = [run for each in alike.values() for run in each.left_out]
    ours = _newest_of_seeds(Runs(alike.pop(reference).rows))
    left += ours.left_out
    kept = {reference: ours.rows}
    for method, each in alike.items():
        same = _on_the_test_set_of(Runs(each.rows), ours, reference)
        newest = _newest_of_seeds(same)
        left += newest.left_out
        if newest.rows:
            kept[method] = newest.rows
    chosen = _at_common_seeds(kept, reference)
    return Runs(chosen.rows, (*left, *chosen.left_out))


def _of_one_configuration(runs: Runs) -> Runs:
    newest = runs.rows[0]

    def reason(run: FinishedRun) -> str | None:
        if run.results["configuration"] == newest.results["configuration"]:
            return None
        differs = differences(all_values(run.results), all_values(newest.results))
        return f"its settings are not those of the newest run of {run.method}, {newest.label}: {differs}"

    return runs.without(reason)


def _newest_of_seeds(runs: Runs) -> Runs:
    newest = {seed: own.rows[0] for seed, own in runs.groupby(lambda run: run.seed).items()}

    def reason(run: FinishedRun) -> str | None:
        if newest[run.seed] is run:
            return None
        return f"a newer run of the same settings and seed replaces it, {newest[run.seed].label}"

    return runs.without(reason)


def _on_the_test_set_of(runs: Runs, ours: Runs, reference: str) -> Runs:
    by_seed = {run.seed: run for run in ours.rows}

    def reason(run: FinishedRun) -> str | None:
        other = by_seed.get(run.seed)
        if other is None:
            return f"{reference} has no run of seed {run.seed}"
        if run.results["test_set"] == other.results["test_set"]:
            return None
        differs = differences(all_values(run.results), all_values(other.results))
        differs = differs or "the settings are equal, so another machine or library drew them"
        return f"its test images or labels are not those of {other.label}: {differs}"

    return runs.without(reason)


def _at_common_seeds(runs: Mapping[str, Sequence[FinishedRun]], reference: str) -> Runs:
    """Choose the runs at the seeds that all methods share.

    Methods with many seeds are added first. A method that would leave no common seed is left out.
    """
    of = {method: {run.seed: run for run in rows} for method, rows in runs.items()}
    seeds, chosen, left = set(of[reference]), [reference], []
    for method in sorted(of.keys() - {reference}, key=lambda name: (-len(of[name]), name)):
        if seeds & set(of[method]):
            chosen.append(method)
            seeds &= set(of[method])
        else:
            reason = f"no seed is common to it and {', '.join(chosen)}"
            left += [LeftOut.of(run, reason) for run in of[method].values()]

    for run in (run for method in chosen for run in of[method].values() if run.seed not in seeds):
        lacking = [method for method in chosen if run.seed not in of[method]]
        left.append(LeftOut.of(run, f"there is no run of seed {run.seed} of {', '.join(lacking)}"))
    order = [reference, *sorted(chosen[1:])]
    return Runs(tuple(of[method][seed] for method in order for seed in sorted(seeds)), tuple(left))


def _grouped(kept: Mapping[tuple[str, str], tuple[FinishedRun, ...]]) -> Iterable[Group]:
    for setting in dict.fromkeys(setting for setting, _ in kept):
        own = {scoring: runs for (name, scoring), runs in kept.items() if name == setting}
        what = headings([scored_values(runs[0].results) for runs in own.values()])
        for (scoring, runs), heading in zip(own.items(), what, strict=True):
            label = setting if len(own) == 1 else f"{setting}, scoring {scoring[:8]}"
            yield Group(setting, label, heading, runs)
