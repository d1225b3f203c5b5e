"""Finished runs, read back from MLflow: results and detections, image by image."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neural_sim.detector.protocol import Score
from neural_sim.report import logged
from neural_sim.report.bootstrap import Outcomes, match
from neural_sim.types import LabelledImages

FILES = ("results.json", "detections.json")


class Recorded:
    """What a results.json says of its run."""

    results: Mapping[str, Any]

    @property
    def method(self) -> str:
        return self.results["method"]

    @property
    def seed(self) -> int:
        return self.results["seed"]

    @property
    def score(self) -> Score:
        """What its detectors are scored by; runs of before there were classifiers do not say so."""
        return self.results.get("score", "AP")

    @property
    def setting(self) -> str:
        """The experiment, with its gap unless that is the experiment's own."""
        gap = self.results["gap"]
        return self.results["experiment"] + ("" if gap == "disjoint" else f", {gap}")


@dataclass(frozen=True)
class Candidate(Recorded):
    """A run in MLflow: its results.json, or why there is none to compare (``unusable``).

    ``detections`` fetches its detections.json.
    """

    name: str
    run_id: str
    experiment: str
    results: Mapping[str, Any] = field(default_factory=dict)
    detections: Callable[[], Path] = Path
    unusable: str | None = None


@dataclass(frozen=True)
class FinishedRun(Recorded):
    """One run's results.json, and the matches of its biased objects for each of its detectors: ns, learned, matched,
    and where photographs trained too, synthetic_only, real_only and views_only.
    """

    results: Mapping[str, Any]
    matches: Mapping[str, Sequence[Outcomes]]

    def spent(self, key: str) -> float:
        """What the method needed in all: images, detector_steps, products, seconds or cpu_seconds."""
        return float(self.results["curve"][-1][key])


def candidates(uri: str, experiments: Sequence[str]) -> list[Candidate]:
    """The runs of MLflow experiments, those of each the newest first.

    Raises:
        ValueError: no such experiment.
    """
    return [_candidate(run, name) for name in dict.fromkeys(experiments) for run in logged.runs(uri, name)]


def _candidate(run: logged.LoggedRun, experiment: str) -> Candidate:
    missing = [name for name in FILES if name not in run.files]
    if run.status != "FINISHED":
        return Candidate(run.name, run.run_id, experiment, unusable=f"its status in MLflow is {run.status}")
    if missing:
        return Candidate(
            run.name, run.run_id, experiment, unusable=f"it was not evaluated: it left no {missing[0]}"
        )
    results = json.loads(run.fetch(FILES[0]).read_text())
    return Candidate(run.name, run.run_id, experiment, results, lambda: run.fetch(FILES[1]))


def read_run(candidate: Candidate) -> FinishedRun:
    """A run with biased objects, its detections matched to the test set's boxes."""
    results = candidate.results
    stored = json.loads(candidate.detections().read_text())
    names, count = list(results["psi"]), stored["images"]
    truth = _images(stored["truth"], count)
    labels = [names.index(name) for name in results["biased"]]
    detections = {w: _detections(rows, count) for w, rows in stored.items() if w not in ("images", "truth")}
    matches = {
        which: [match(own, truth, label, candidate.score) for label in labels]
        for which, own in detections.items()
    }
    return FinishedRun(results, matches)


def _detections(rows: Sequence[Mapping[str, Any]], count: int) -> list[dict[str, Tensor]]:
    """COCO result rows, image by image."""
    grouped: list[list[Mapping[str, Any]]] = [[] for _ in range(count)]
    for row in rows:
        grouped[row["image_id"]].append(row)
    detections = []
    for group in grouped:
        boxes = torch.tensor([row["bbox"] for row in group]).reshape(-1, 4)
        corners = torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], -1)
        labels = torch.tensor([row["category_id"] - 1 for row in group], dtype=torch.long)
        scores = torch.tensor([row["score"] for row in group])
        detections.append({"boxes": corners, "labels": labels, "scores": scores})
    return detections


def _images(rows: Sequence[Mapping[str, Any]], count: int) -> LabelledImages:
    """The truth's boxes as a set without pixels."""
    boxes_by_image = _detections(rows, count)
    most = max(len(image["labels"]) for image in boxes_by_image)
    boxes, labels = torch.zeros(count, most, 4), torch.full((count, most), -1)
    for index, image in enumerate(boxes_by_image):
        boxes[index, : len(image["labels"])] = image["boxes"]
        labels[index, : len(image["labels"])] = image["labels"]
    return LabelledImages(torch.zeros(count, 3, 1, 1), boxes, labels, torch.zeros(count, dtype=torch.long))
