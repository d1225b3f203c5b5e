"""What a run leaves in its folder: results.json, figures, the final training set in COCO form."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.detector.metrics import mean_of
from neural_sim.detector.protocol import Score
from neural_sim.outer.certificate import untrusted
from neural_sim.parameter.distributions import merged, total_variation
from neural_sim.report import figures
from neural_sim.synthesis.assembly import RenderedImages
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.types import LabelledImages

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunResults:
    """Everything the report shows. ``probabilities`` are those of initial, learned and target, by factor, [objects, k];
    ``ap`` maps ns, learned, matched to scores on the test set. Photographs whose distribution is not known have neither
    target nor matched. ``validation_ap`` is that of the learned distribution's
    detector on the validation images, which steered psi too: settings are chosen by it, nothing is reported by it.
    ``curve`` has what the method had spent (images, detector_steps, products, seconds) and what its psi was worth
    (``ap``) at every iteration that was scored.

    ``memory`` is the largest so far in MB by name, see :func:`devices.peak_memory_mb`. ``symmetric_bins`` groups bins
    (from 1), by object and angle, whose views an object's symmetry makes the same; they are scored and drawn as one.
    ``real`` says how photographs trained (``mode``) and how many (``photographs``); empty without. ``ap`` then also has
    the scores of synthetic_only, real_only and views_only.
    ``score`` is what detectors are scored by: AP, or accuracy, which ``ap`` then has.
    ``identity`` says which runs this one can be compared with, see :func:`identity.identity`.
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

    def document(self) -> dict[str, Any]:
        """The content of results.json; numbers that do not exist (the score of an absent class) are null."""
        psi = {
            name: {
                factor: {which: p[factor][label].tolist() for which, p in self.probabilities.items()}
                for factor in self.factors
            }
            for label, name in enumerate(self.names)
        }
        return _finite(
            {
                "experiment": self.experiment,
                "method": self.method,
                "seed": self.seed,
                "gap": self.config.get("gap", "disjoint"),
                "biased": list(self.biased),
                "psi": psi,
                "total_variation": self.total_variations(),
                "symmetric_bins": dict(self.symmetric_bins),
                "score": self.score,
                "ap": dict(self.ap),
                "validation_ap": self.validation_ap,
                "real": dict(self.real),
                "curve": list(self.curve),
                "certificates": untrusted(self.records),
                "images_without_box": self.images_without_box(),
                "iterations": list(self.records),
                "fields": {name: history[-1] for name, history in self.fields.items() if history},
                "seconds": dict(self.seconds),
                **self.memory,
                "left_out": list(self.left_out),
                **self.identity,
            }
        )

    def images_without_box(self) -> int:
        """Training images of the psi loop in which the object was out of frame or too small to get a box."""
        return sum(record["images_without_box"] for record in self.records)

    @property
    def factors(self) -> tuple[str, ...]:
        """Names of what is learned, in order."""
        return tuple(self.probabilities["learned"])

    def groups(self, name: str, factor: str) -> Sequence[Sequence[int]]:
        """Groups of a factor's bins (from 1) that look the same for an object; a bin each where nothing is known."""
        bins = self.probabilities["learned"][factor].shape[-1]
        return self.symmetric_bins.get(name, {}).get(factor) or [[b] for b in range(1, bins + 1)]

    def total_variations(self) -> dict[str, dict[str, dict[str, float]]]:
        """Distance of the initial and the learned distribution from the target, by object and factor, over groups;
        empty for every object where the target is not known.
        """
        distances: dict[str, dict[str, dict[str, float]]] = {name: {} for name in self.names}
        if "target" not in self.probabilities:
            return distances
        for label, name in enumerate(self.names):
            for factor in self.factors:
                groups = self.groups(name, factor)
                p = {which: merged(p[factor][label], groups) for which, p in self.probabilities.items()}
                distances[name][factor] = {
                    which: float(total_variation(p[which], p["target"])) for which in ("initial", "learned")
                }
        return distances

    def summary(self) -> str:
        """The table printed at the end of a run."""
        head = f"{f'{self.score} on the test set':<24}" + "".join(
            f"{name[:12]:>13}" for name in (*self.names, "mean")
        )
        lines = [head]
        for method, scores in self.ap.items():
            values = [*(scores["per_class"][name] for name in self.names), mean_of(scores)]
            lines.append(f"{method:<24}" + "".join(f"{100 * value:>13.1f}" for value in values))
        if self.real:
            lines.append(
                "trained on {photographs} photographs too (training.real.mode={mode})".format(**self.real)
            )
        if self.validation_ap is not None:
            score = f"{100 * self.validation_ap:.1f}"
            lines.append(f"{self.score} on the validation images, learned: {score} (to choose settings by)")
        distances = self.total_variations()
        for factor in self.factors if "target" in self.probabilities else ():
            lines.append(f"distance to target, {factor}")
            for which in ("initial", "learned"):
                row = "".join(f"{distances[name][factor][which]:>13.2f}" for name in self.names)
                lines.append(f"  {which:<22}{row}")
        trust = untrusted(self.records)
        if trust["steps"]:
            lines.append(_trust_line(trust))
        if self.images_without_box():
            lines.append(f"images of the psi loop without a box: {self.images_without_box()}")
        spent = ", ".join(f"{name} {value:.1f}" for name, value in self.seconds.items())
        gpu = self.memory.get("peak_gpu_memory_mb")
        memory = f"{self.memory['peak_memory_mb']:.0f} MB" + (
            "" if gpu is None else f", on the GPU {gpu:.0f} MB"
        )
        lines.append(f"seconds: {spent}; peak memory {memory}")
        if self.left_out:
            lines.append(_left_out_line(self.left_out))
        return "\n".join(lines)


def _left_out_line(left_out: Sequence[Mapping[str, Any]]) -> str:
    """Fractions of the work that was left out, and the results that the store had."""
    stored = [o for o in left_out if o["why"] == "found in the store"]
    others = [o for o in left_out if o not in stored and o["fraction"] is not None]
    parts = [f"{o['what']} {o['fraction']:.0%}" for o in others]
    if stored:
        spared = sum(o["seconds"] for o in stored)
        parts.append(f"{len(stored)} results from the store ({spared:.0f} s)")
    return "left out: " + ", ".join(parts)


def _trust_line(trust: Mapping[str, Any]) -> str:
    """How many psi steps of objects and factors were not trusted, why, and what became of them."""
    text = f"untrusted psi steps of objects: {trust['untrusted']} of {trust['steps']}"
    for part in ("actions", "doubts"):
        if trust[part]:
            text += "; " + ", ".join(f"{name} {count}" for name, count in trust[part].items())
    if trust["waited"]:
        text += f"; of the others, {trust['waited']} waited (little gain, or a spent trust radius)"
    if trust["judged"]:
        text += f"; rejected after training on them {trust['rejected']} of {trust['judged']}"
    if trust["cosines"]:
        text += "; cosine with the response of training " + ", ".join(f"{c:.2f}" for c in trust["cosines"])
    return text


def write_results(results: RunResults, folder: Path) -> Path:
    """results.json in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "results.json"
    path.write_text(json.dumps(results.document(), indent=1, allow_nan=False))
    return path


def write_figures(
    results: RunResults,
    drawn: LabelledImages,
    test: LabelledImages,
    detections: Sequence[Mapping[str, Tensor]],
    folder: Path,
) -> list[Path]:
    """The run's figures as PNG files."""
    names, paths = list(results.names), []
    for factor in results.factors if results.records else ():
        target = results.probabilities.get("target")
        wanted = None if target is None else dict(zip(names, target[factor].tolist(), strict=True))
        steps = [*(r["probabilities"][factor] for r in results.records)]
        steps.append(results.probabilities["learned"][factor].tolist())
        history = {name: [p[i] for p in steps] for i, name in enumerate(names)}
        title = f"{results.experiment}: learned {factor}, {results.method}, seed {results.seed}"
        groups = {name: results.groups(name, factor) for name in names}
        drawn_psi = figures.psi_figure(history, wanted, title, factor, groups)
        paths.append(figures.save(drawn_psi, folder / f"psi_{factor}.png"))
    if results.ap:
        paths.append(
            figures.save(
                figures.ap_figure(results.ap, names, results.biased, results.score), folder / "ap.png"
            )
        )
    chosen = _spread(drawn, 32)
    grid = figures.image_grid(
        drawn.select(chosen), names, title="Training images drawn from the learned distribution"
    )
    paths.append(figures.save(grid, folder / "training_images.png"))
    if detections:
        chosen = _spread(test, 32)
        shown = [detections[int(i)] for i in chosen]
        title = "Detections on the test set (dashed: truth)"
        grid = figures.image_grid(test.select(chosen), names, predictions=shown, title=title)
        paths.append(figures.save(grid, folder / "detections.png"))
    return paths


def write_training_set(rendered: RenderedImages, names: Sequence[str], folder: Path) -> Path:
    """The final training set as COCO: images and a JSON that holds the pose of every object in them."""
    poses: list[list[dict[str, Any]]] = [[] for _ in range(len(rendered))]
    for label, (part, rows) in enumerate(zip(rendered.objects, rendered.rows, strict=True)):
        draw, distance = part.draw, part.draw.distance / part.draw.radius  # object radii
        values = {name: getattr(draw, name) for name in ("phi", "rho", "magnification", "bins")}
        values |= {"distance": distance, "camera_to_world": orbit(draw.phi, draw.rho, distance)}
        listed = {key: value.tolist() for key, value in values.items() if value is not None}
        for place, row in enumerate(rows.tolist()):
            pose = {key: value[place] for key, value in listed.items()}
            poses[row].append({"category_id": label + 1, **pose})
    return write_coco(rendered.images, list(names), folder, poses)


def write_detections(
    test: LabelledImages, detections: Mapping[str, Sequence[Mapping[str, Tensor]]], folder: Path
) -> Path:
    """detections.json: the test set's boxes (``truth``) and every detector's detections, as COCO result rows."""
    truth = [
        {"boxes": b[k], "labels": n[k]} for b, n, k in zip(test.boxes, test.labels, test.present, strict=True)
    ]
    rows = {"images": len(test), "truth": _rows(truth)}
    rows |= {which: _rows(images) for which, images in detections.items()}
    path = folder / "detections.json"
    path.write_text(json.dumps(rows))
    return path


def _rows(images: Sequence[Mapping[str, Tensor]]) -> list[dict[str, Any]]:
    """One row a box: image_id from 0, category_id from 1, bbox as (x, y, width, height) in pixels, score."""
    rows = []
    for index, image in enumerate(images):
        scores = image.get("scores", torch.ones(len(image["labels"])))
        for box, label, score in zip(
            image["boxes"].tolist(), image["labels"].tolist(), scores.tolist(), strict=True
        ):
            x0, y0, x1, y1 = (round(side, 3) for side in box)
            row = {"image_id": index, "category_id": label + 1, "bbox": [x0, y0, x1 - x0, y1 - y0]}
            rows.append({**row, "score": round(score, 5)})
    return rows


def _spread(images: LabelledImages, count: int) -> Tensor:
    """Indices of up to ``count`` images spread over the set."""
    return torch.linspace(0, len(images) - 1, min(count, len(images))).round().long()


def _finite(tree: Any) -> Any:
    """NaN and infinities as None, so that the file is JSON by the standard."""
    if isinstance(tree, Mapping):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    if isinstance(tree, float) and not math.isfinite(tree):
        return None
    return tree
