"""Which finished runs can be compared with which, and why the others cannot.

AP is comparable between runs that share what is scored (``scoring``) and the test images of a seed (``test_set``).
Seeds may be averaged where a method ran with the same settings for all of them (``configuration``). See
:mod:`identity`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from neural_sim.report.finished import Candidate
from neural_sim.report.identity import KEYS, all_values, differences, headings, scored_values
from neural_sim.report.statistics import FIXED


@dataclass(frozen=True)
class LeftOut:
    """A run that a comparison does not use, and the reason."""

    run: str
    run_id: str
    experiment: str
    reason: str


@dataclass(frozen=True)
class Group:
    """Runs to compare: one of each method at each of ``seeds``.

    ``label`` names the group among all of a comparison. ``heading`` says how it differs from other groups of the
    same setting; it is empty for the only one.
    """

    setting: str
    label: str
    heading: str
    seeds: tuple[int, ...]
    runs: tuple[Candidate, ...]


class Selection:
    """The groups of runs that a comparison with ``reference`` is made of, and what it leaves out.

    ``candidates`` are the runs of all experiments asked for, those of each the newest first. ``methods`` are those to
    compare beside the reference, None: all.
    """

    def __init__(
        self, candidates: Sequence[Candidate], reference: str, methods: Sequence[str] | None = None
    ) -> None:
        self.reference, self.methods = reference, methods
        self.left_out: list[LeftOut] = []
        usable = [run for run in candidates if self._usable(run)]
        keyed: dict[tuple[str, str], list[Candidate]] = {}
        for run in usable:
            keyed.setdefault((run.setting, run.results["scoring"]), []).append(run)
        anchors = {key: _of(runs, reference) for key, runs in keyed.items()}
        kept = {}
        for key, runs in keyed.items():
            if anchors[key]:
                kept[key] = self._comparable(runs)
            else:
                self._no_reference(runs, [a[0] for (s, _), a in anchors.items() if a and s == key[0]])
        self.groups = [group for group in _grouped(kept) if group.runs]

    def _leave(self, runs: Iterable[Candidate], reason: str) -> None:
        self.left_out += [LeftOut(run.name, run.run_id, run.experiment, reason) for run in runs]

    def _usable(self, run: Candidate) -> bool:
        reason = run.unusable
        if reason is None and self.methods is not None and run.method not in (self.reference, *self.methods):
            reason = "compare.methods does not name its method"
        elif reason is None and not all(run.results.get(key) for key in KEYS):
            reason = "an older version wrote it, without the digests that say what it can be compared with"
        elif reason is None and not (run.results["biased"] and run.results["curve"]):
            reason = "none of its objects starts from another distribution than its target's"
        elif reason is None and run.method in FIXED and run.method != self.reference:
            reason = "every run trains and scores this detector itself: rows ns and matched"
        if reason is not None:
            self._leave([run], reason)
        return reason is None

    def _no_reference(self, runs: Sequence[Candidate], anchors: Sequence[Candidate]) -> None:
        """``anchors``: the reference's newest runs of the same setting, scored in other ways."""
        for run in runs:
            if anchors:
                differs = differences(scored_values(run.results), scored_values(anchors[0].results))
                why = f"no run of {self.reference} is scored in the same way; beside {_named(anchors[0])}, {differs}"
            else:
                why = f"{self.reference} has no run of this setting"
            self._leave([run], why)

    def _comparable(self, runs: Sequence[Candidate]) -> list[Candidate]:
        """One run of each method at each seed that they have in common, the reference's first."""
        methods = sorted({run.method for run in runs}, key=lambda m: (m != self.reference, m))
        alike = {method: self._one_configuration(_of(runs, method)) for method in methods}
        own = self._newest(alike.pop(self.reference))
        others = {m: self._newest(self._same_test_set(theirs, own)) for m, theirs in alike.items()}
        others = {m: theirs for m, theirs in others.items() if theirs}
        return self._common_seeds({self.reference: own} | others)

    def _one_configuration(self, runs: Sequence[Candidate]) -> list[Candidate]:
        newest = runs[0]
        kept = [run for run in runs if run.results["configuration"] == newest.results["configuration"]]
        for run in runs:
            if run not in kept:
                differs = differences(all_values(run.results), all_values(newest.results))
                self._leave([run], f"not run as the newest of {run.method}, {_named(newest)}: {differs}")
        return kept

    def _newest(self, runs: Sequence[Candidate]) -> dict[int, Candidate]:
        by_seed: dict[int, Candidate] = {}
        for run in runs:
            if run.seed in by_seed:
                newer = _named(by_seed[run.seed])
                self._leave([run], f"a newer run of the same settings and seed stands for it, {newer}")
            by_seed.setdefault(run.seed, run)
        return by_seed

    def _same_test_set(self, runs: Sequence[Candidate], own: Mapping[int, Candidate]) -> list[Candidate]:
        kept = []
        for run in runs:
            reference = own.get(run.seed)
            if reference is None:
                self._leave([run], f"{self.reference} has no run of seed {run.seed}")
            elif run.results["test_set"] != reference.results["test_set"]:
                differs = differences(all_values(run.results), all_values(reference.results))
                differs = differs or "the settings are equal, so another machine or library drew them"
                self._leave(
                    [run], f"its test images or labels are not those of {_named(reference)}: {differs}"
                )
            else:
                kept.append(run)
        return kept

    def _common_seeds(self, runs: dict[str, dict[int, Candidate]]) -> list[Candidate]:
        """Methods with many seeds come first; one that would leave no seed in common is left out."""
        seeds = set(runs[self.reference])
        chosen = [self.reference]
        others = sorted((m for m in runs if m != self.reference), key=lambda m: (-len(runs[m]), m))
        for method in others:
            if seeds & set(runs[method]):
                chosen.append(method)
                seeds &= set(runs[method])
            else:
                what = f"it shares no seed with all of {', '.join(chosen)}"
                self._leave(runs[method].values(), what)
        for method in chosen:
            for seed, run in runs[method].items():
                if seed not in seeds:
                    lacking = [other for other in chosen if seed not in runs[other]]
                    self._leave([run], f"there is no run of seed {seed} of {', '.join(lacking)}")
        order = [self.reference, *sorted(chosen[1:])]
        return [runs[method][seed] for method in order for seed in sorted(seeds)]


def _of(runs: Iterable[Candidate], method: str) -> list[Candidate]:
    return [run for run in runs if run.method == method]


def _named(run: Candidate) -> str:
    return f"{run.name} ({run.run_id[:8]})"


def _grouped(kept: Mapping[tuple[str, str], Sequence[Candidate]]) -> Iterable[Group]:
    for setting in dict.fromkeys(setting for setting, _ in kept):
        own = {scoring: runs for (s, scoring), runs in kept.items() if s == setting}
        what = headings([scored_values(runs[0].results) for runs in own.values()])
        for (scoring, runs), heading in zip(own.items(), what, strict=True):
            label = setting if len(own) == 1 else f"{setting}, scoring {scoring[:8]}"
            yield Group(setting, label, heading, tuple(sorted({run.seed for run in runs})), tuple(runs))
