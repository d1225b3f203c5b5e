"""The results of a run: results.json, and the printed summary; and the table of a sweep's runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml
from torch import Tensor

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.detector.metrics import mean_of, mean_over
from neural_sim.detector.protocol import Score
from neural_sim.documents import finite, markdown_table, plain_table, read_json, write_json
from neural_sim.outer.certificate import untrusted
from neural_sim.outer.objective import UNSEEN
from neural_sim.parameter.distributions import merged, total_variation
from neural_sim.report.provenance import Made, caution

CALLED = {
    "ns": "before",
    "learned": "after",
    "matched": "if the target were known",
    "synthetic_only": "after, no photographs",
    "real_only": "photographs alone",
    "views_only": "the fields' views alone",
}
"""Descriptions of each detector's training images, by the detector's name in files."""


@dataclass(frozen=True)
class Learned:
    """The distribution of one factor of one object: initial, learned, and the target's.

    Args:
        name: the object.
        factor: the factor of the parameters, for instance ``pose``.
        groups: groups of bins (from 1) that look the same, which are scored and drawn as one; one bin in each if
            nothing is known.
        p: probabilities of the bins: ``initial``, ``learned`` and, if known, ``target``.
        history: probabilities at the start of every iteration, and the learned ones; one row if nothing was learned.
        distances: total variation of ``initial`` and ``learned`` from the target, over groups; empty if the target's
            distribution is not known.
    """

    name: str
    factor: str
    groups: Sequence[Sequence[int]]
    p: Mapping[str, Sequence[float]]
    history: Sequence[Sequence[float]]
    distances: Mapping[str, float]


@dataclass(frozen=True)
class RunResults:
    """Everything that the report shows.

    Args:
        experiment: name of the experiment.
        method: the method that chose the training images.
        seed: seed of the run.
        names: names of the objects, in the order of their labels.
        biased: objects whose initial distribution is not the target's.
        probabilities: ``initial``, ``learned`` and ``target`` by factor, [objects, k]. For photographs whose
            distribution is not known, there is neither a target nor ``matched`` in ``ap``.
        records: iterations of the psi loop.
        ap: scores on the test set of ns, learned and matched and, if training also uses photographs, of synthetic_only,
            real_only and views_only.
        fields: scores of every object's field while it was fitted.
        seconds: seconds by stage.
        memory: peak memory so far in MB by name, see ``devices.peak_memory_mb``.
        left_out: work that was not done, and why.
        config: the whole configuration.
        validation_ap: score of the detector ``learned`` on the validation images of the outer objective. It is for
            choosing settings, and never reported as a result.
        curve: cost so far (images, detector_steps, products, seconds) and score of the present psi (``ap``), at every
            iteration that was scored.
        symmetric_bins: groups of bins (from 1), by object and angle, whose views an object's symmetry makes the same.
        identity: digests that say which runs are comparable, see ``identity.identity``.
        real: how training used photographs (``mode``) and how many (``photographs``); empty without photographs.
        score: the kind of score in ``ap``: AP, or accuracy.
        shown: the estimate from the target's boxes; empty if none was made.
        made: how the run was made.
    """

    experiment: str
    method: str
    seed: int
    names: Sequence[str]
    biased: Sequence[str]
    probabilities: Mapping[str, Mapping[str, Tensor]]
    records: Sequence[Mapping[str, Any]]
    ap: Mapping[str, Mapping[str, Any]]
    fields: Mapping[str, Sequence[Mapping[str, float]]]
    seconds: Mapping[str, float]
    memory: Mapping[str, float]
    left_out: Sequence[Mapping[str, Any]]
    config: Mapping[str, Any]
    validation_ap: float | None = None
    curve: Sequence[Mapping[str, Any]] = ()
    symmetric_bins: Mapping[str, Mapping[str, Sequence[Sequence[int]]]] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    real: Mapping[str, Any] = field(default_factory=dict)
    score: Score = "AP"
    shown: Sequence[FactorEstimate] = ()
    made: Made = field(default_factory=Made)

    @property
    def moved(self) -> bool:
        """Whether the method could move psi."""
        return bool(self.records) or bool(self.shown)

    @property
    def factors(self) -> tuple[str, ...]:
        """Names of the learned factors, in order."""
        return tuple(self.probabilities["learned"])

    @cached_property
    def learned(self) -> tuple[Learned, ...]:
        """The distributions of every object and factor, object by object."""
        found = []
        for label, name in enumerate(self.names):
            for factor in self.factors:
                p = {which: values[factor][label] for which, values in self.probabilities.items()}
                bins = [[b] for b in range(1, len(p["learned"]) + 1)]
                groups = self.symmetric_bins.get(name, {}).get(factor) or bins
                listed = {which: values.tolist() for which, values in p.items()}
                steps = [record["probabilities"][factor][label] for record in self.records]
                # The first record may already follow a proposed first step.
                before = [listed["initial"], *steps[1:]] if self.moved else []
                history = [*before, listed["learned"]]
                found.append(Learned(name, factor, groups, listed, history, _distances(p, groups)))
        return tuple(found)

    def of_factor(self, factor: str) -> list[Learned]:
        """Return the distributions of a factor for all objects."""
        return [one for one in self.learned if one.factor == factor]

    @property
    def target_known(self) -> bool:
        """Whether the target's distribution is known."""
        return "target" in self.probabilities

    @property
    def images_without_box(self) -> int:
        """Training images of the psi loop in which the object was out of frame or too small to get a box."""
        return sum(record["images_without_box"] for record in self.records)

    def document(self) -> dict[str, Any]:
        """Return the content of results.json; numbers that do not exist (the score of an absent class) are null."""
        psi: dict[str, dict[str, Any]] = {name: {} for name in self.names}
        away: dict[str, dict[str, Any]] = {name: {} for name in self.names}
        for one in self.learned:
            psi[one.name][one.factor] = one.p
            if one.distances:
                away[one.name][one.factor] = one.distances
        return finite(
            {
                "experiment": self.experiment,
                "method": self.method,
                "seed": self.seed,
                "scale": self.made.scale,
                "command": self.made.command,
                "date": self.made.date,
                "machine": self.made.machine,
                "gap": self.config.get("gap", "disjoint"),
                "biased": self.biased,
                "psi": psi,
                "total_variation": away,
                "symmetric_bins": self.symmetric_bins,
                "score": self.score,
                "ap": self.ap,
                "validation_ap": self.validation_ap,
                "real": self.real,
                "curve": self.curve,
                "shown": [dataclasses.asdict(one) for one in self.shown],
                "certificates": untrusted(self.records),
                "images_without_box": self.images_without_box,
                "iterations": self.records,
                "fields": {name: history[-1] for name, history in self.fields.items() if history},
                "seconds": self.seconds,
                **self.memory,
                "left_out": self.left_out,
                **self.identity,
            }
        )

    def summary(self) -> str:
        """Return the table printed at the end of a run."""
        lines = [self.made.caution] if self.made.caution else []
        lines += [f"{self.score} on {self.made.shows}", self._score_table()]
        if self.real:
            lines.append(
                "also trained on {photographs} photographs (training.real.mode={mode})".format(**self.real)
            )
        if self.validation_ap is not None:
            score = f"{100 * self.validation_ap:.1f}"
            lines.append(f"{self.score} on the validation images, after: {score} (to choose settings by)")
        lines += [one.sentence for one in self.shown]
        if self._unfound and not self.made.caution:
            lines.append(
                f"next to nothing is found of {', '.join(self._unfound)}; objects.html shows whether their fields are "
                "good"
            )
        trust = untrusted(self.records)
        if trust["steps"]:
            lines.append(_trust_line(trust))
        if self.images_without_box:
            lines.append(f"images of the psi loop without a box: {self.images_without_box}")
        spent = ", ".join(f"{name} {value:.1f}" for name, value in self.seconds.items())
        gpu = self.memory.get("peak_gpu_memory_mb")
        on_gpu = "" if gpu is None else f", on the GPU {gpu:.0f} MB"
        lines.append(f"seconds: {spent}; peak memory {self.memory['peak_memory_mb']:.0f} MB{on_gpu}")
        if self.left_out:
            lines.append(_left_out_line(self.left_out))
        return "\n".join(lines)

    @property
    def _unfound(self) -> list[str]:
        """Names and scores of the objects of which the last detector finds next to nothing."""
        scores = self.ap["learned"]["per_class"]
        return [
            f"{name} ({self.score} {100 * value:.1f})" for name, value in scores.items() if value < UNSEEN
        ]

    def _score_table(self) -> str:
        """Return scores, and distances of the distributions to the target's, with a line for each object."""
        factors = self.factors if self.target_known else ()
        head = [CALLED.get(method, method) for method in self.ap]
        head += [f"{factor}, distance to target" for factor in factors]
        away = {(one.name, one.factor): one.distances for one in self.learned}
        rows = []
        for name in self.names:
            row = [f"{100 * scores['per_class'][name]:.1f}" for scores in self.ap.values()]
            row += ["{initial:.2f} -> {learned:.2f}".format(**away[name, factor]) for factor in factors]
            rows.append([name, *row])
        means = [f"{100 * mean_of(scores):.1f}" for scores in self.ap.values()]
        return plain_table(["", *head], [*rows, ["mean", *means, *("" for _ in factors)]])


def _distances(p: Mapping[str, Tensor], groups: Sequence[Sequence[int]]) -> dict[str, float]:
    if "target" not in p:
        return {}
    one = {which: merged(values, groups) for which, values in p.items()}
    return {which: float(total_variation(one[which], one["target"])) for which in ("initial", "learned")}


def _left_out_line(left_out: Sequence[Mapping[str, Any]]) -> str:
    """Write fractions of the work that was left out, and the number of results read from the store."""
    stored = [o for o in left_out if o["why"] == "found in the store"]
    others = [o for o in left_out if o not in stored and o["fraction"] is not None]
    parts = [f"{o['what']} {o['fraction']:.0%}" for o in others]
    if stored:
        spared = sum(o["seconds"] for o in stored)
        parts.append(f"{len(stored)} results from the store ({spared:.0f} s)")
    return "left out: " + ", ".join(parts)


def _trust_line(trust: Mapping[str, Any]) -> str:
    """Write how many psi steps of objects and factors were not trusted, why, and what happened to them."""
    text = f"untrusted psi steps of objects: {trust['untrusted']} of {trust['steps']}"
    for part in ("actions", "doubts"):
        if trust[part]:
            text += "; " + ", ".join(f"{name} {count}" for name, count in trust[part].items())
    if trust["waited"]:
        text += f"; of the trusted, {trust['waited']} waited (little gain, or a spent trust radius)"
    if trust["judged"]:
        text += f"; trainings rejected {trust['rejected']} of the {trust['judged']} that they judged"
    if trust["taken_back"]:
        backs = (
            f"{name} (keeps {b['kept']} of {b['accepted']} steps)" for name, b in trust["taken_back"].items()
        )
        text += f"; taken back at the end {', '.join(backs)}"
    if trust["cosines"]:
        text += "; cosine with the response of training " + ", ".join(f"{c:.2f}" for c in trust["cosines"])
    return text


def write_results(results: RunResults, folder: Path) -> Path:
    """Write results.json."""
    return write_json(folder / "results.json", results.document())


# --- sweeps ---

SCORED = ("ns", "learned", "matched")


def sweep_table(folder: Path) -> str:
    """Return the table of a sweep's runs; empty if fewer than two left results.

    Args:
        folder: the sweep's folder, with a subfolder for each job, whose name begins with the job's number.
    """
    jobs = sorted((path for path in folder.iterdir() if (path / ".hydra").is_dir()), key=_number)
    results = {job: read_json(job / "results.json") for job in jobs if (job / "results.json").is_file()}
    if len(results) < 2:
        return ""
    settings = {job: _overrides(job) for job in jobs}
    keys = dict.fromkeys(key for own in settings.values() for key in own)
    swept = [key for key in keys if len({own.get(key, "") for own in settings.values()}) > 1]
    score = next(iter(results.values()))["score"]
    rows = [
        [*(settings[job].get(key, "") for key in swept), *_scores(results.get(job)), job.name] for job in jobs
    ]
    head = [*swept, *(f"{score} {CALLED[which]}" for which in SCORED), "folder"]
    notes = [said for scale in {own.get("scale", "") for own in results.values()} if (said := caution(scale))]
    about = f"{score} in points: the mean over the objects that start away from the target, or over all if none does."
    return "\n\n".join([*notes, markdown_table(head, rows), about, f"pages: {folder}/<folder>/report.html"])


def _number(job: Path) -> int:
    number = job.name.partition("_")[0]
    return int(number) if number.isdecimal() else 0


def _overrides(job: Path) -> dict[str, str]:
    words: Sequence[str] = yaml.safe_load((job / ".hydra" / "overrides.yaml").read_text(encoding="utf-8"))
    parts = (word.lstrip("+").partition("=") for word in words)
    return {key: value for key, _, value in parts}


def _scores(results: Mapping[str, Any] | None) -> list[str]:
    if results is None:
        return ["no results", *[""] * (len(SCORED) - 1)]
    cells = []
    for which in SCORED:
        scores = results["ap"].get(which)
        mean = mean_over(scores, results["biased"] or scores["per_class"]) if scores else math.nan
        cells.append("" if math.isnan(mean) else f"{100 * mean:.1f}")
    return cells
