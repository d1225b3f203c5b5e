"""Finished runs, read back from MLflow: what each method's detectors found, image by image."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neural_sim.report import tracking
from neural_sim.report.bootstrap import Matches, match
from neural_sim.types import LabelledImages

WHICH = ("ns", "learned", "matched")


@dataclass(frozen=True)
class FinishedRun:
    """One run's results.json, and the matches of its biased objects for each detector of ``WHICH``."""

    results: Mapping[str, Any]
    matches: Mapping[str, Sequence[Matches]]

    @property
    def method(self) -> str:
        return self.results["method"]

    @property
    def seed(self) -> int:
        return self.results["seed"]

    @property
    def setting(self) -> str:
        """The experiment, with its gap unless that is the experiment's own."""
        gap = self.results["gap"]
        return self.results["experiment"] + ("" if gap == "disjoint" else f", {gap}")

    def spent(self, key: str) -> float:
        """What the method needed in all: images, detector_steps, products, seconds or cpu_seconds."""
        return float(self.results["curve"][-1][key])


def finished_runs(uri: str, experiments: Sequence[str]) -> list[FinishedRun]:
    """The latest evaluated run of every method, seed and setting of MLflow experiments.

    Raises:
        ValueError: no such experiment, or none with an evaluated run.
    """
    found: dict[tuple[str, str, int], FinishedRun] = {}
    for experiment in experiments:
        for files in tracking.finished_files(uri, experiment, ("results.json", "detections.json")):
            run = read_run(*files.values())
            if run is not None:
                found.setdefault((run.setting, run.method, run.seed), run)
    if not found:
        raise ValueError(
            f"compare.experiments: no run of {', '.join(experiments)} in {uri} was evaluated on biased objects"
        )
    return list(found.values())


def read_run(results_file: Path, detections_file: Path) -> FinishedRun | None:
    """A run from its results.json and detections.json; None where it has no biased object to compare by."""
    results = json.loads(results_file.read_text())
    if not results["biased"] or not results["curve"]:
        return None
    held = json.loads(detections_file.read_text())
    names, count = list(results["psi"]), held["images"]
    truth = _images(held["truth"], count)
    labels = [names.index(name) for name in results["biased"]]
    found = {which: _detections(held[which], count) for which in WHICH}
    return FinishedRun(results, {w: [match(found[w], truth, label) for label in labels] for w in WHICH})


def _detections(rows: Sequence[Mapping[str, Any]], count: int) -> list[dict[str, Tensor]]:
    """COCO result rows, image by image."""
    grouped: list[list[Mapping[str, Any]]] = [[] for _ in range(count)]
    for row in rows:
        grouped[row["image_id"]].append(row)
    found = []
    for group in grouped:
        boxes = torch.tensor([row["bbox"] for row in group]).reshape(-1, 4)
        corners = torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], -1)
        labels = torch.tensor([row["category_id"] - 1 for row in group], dtype=torch.long)
        scores = torch.tensor([row["score"] for row in group])
        found.append({"boxes": corners, "labels": labels, "scores": scores})
    return found


def _images(rows: Sequence[Mapping[str, Any]], count: int) -> LabelledImages:
    """The truth's boxes as a set without pixels."""
    found = _detections(rows, count)
    most = max(len(image["labels"]) for image in found)
    boxes, labels = torch.zeros(count, most, 4), torch.full((count, most), -1)
    for index, image in enumerate(found):
        boxes[index, : len(image["labels"])] = image["boxes"]
        labels[index, : len(image["labels"])] = image["labels"]
    return LabelledImages(torch.zeros(count, 3, 1, 1), boxes, labels, torch.zeros(count, dtype=torch.long))
