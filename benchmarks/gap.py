"""How much of a gap the learned distributions win back, over seeds, with bootstrap intervals.

    python benchmarks/gap.py outputs/runs/pose_gap/sweep_*/* [--json outputs/benchmarks/gap.json]

Each argument is the folder of a finished run (results.json, detections.json). AP is the mean over the biased
objects; ``won back`` is (learned - ns) / (matched - ns) of the means over seeds. The bootstrap draws seeds and, within
each seed, test images with replacement, the same images for all three detectors.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from neural_sim.report.bootstrap import Matches, average_precision, match
from neural_sim.types import LabelledImages

WHICH = ("ns", "learned", "matched")


def read(folder: Path) -> tuple[dict, dict[str, list[Matches]]]:
    """A run's results, and the matches of its biased objects for every detector."""
    results = json.loads((folder / "results.json").read_text())
    held = json.loads((folder / "detections.json").read_text())
    names = list(results["psi"])
    truth = _images(held["truth"], held["images"])
    labels = [names.index(name) for name in results["biased"]]
    return results, {
        w: [match(_detections(held[w], held["images"]), truth, n) for n in labels] for w in WHICH
    }


def _detections(rows: list[dict], count: int) -> list[dict[str, torch.Tensor]]:
    grouped: list[list[dict]] = [[] for _ in range(count)]
    for row in rows:
        grouped[row["image_id"]].append(row)
    found = []
    for group in grouped:
        boxes = torch.tensor([row["bbox"] for row in group]).reshape(-1, 4)
        labels = torch.tensor([row["category_id"] - 1 for row in group], dtype=torch.long)
        scores = torch.tensor([row["score"] for row in group])
        found.append(
            {
                "boxes": torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], -1),
                "labels": labels,
                "scores": scores,
            }
        )
    return found


def _images(rows: list[dict], count: int) -> LabelledImages:
    found = _detections(rows, count)
    most = max(len(image["labels"]) for image in found)
    boxes, labels = torch.zeros(count, most, 4), torch.full((count, most), -1)
    for index, image in enumerate(found):
        boxes[index, : len(image["labels"])], labels[index, : len(image["labels"])] = (
            image["boxes"],
            image["labels"],
        )
    return LabelledImages(torch.zeros(count, 3, 1, 1), boxes, labels, torch.zeros(count, dtype=torch.long))


def mean_ap(matches: list[Matches], weights: np.ndarray | None = None) -> float:
    """Mean over the biased objects."""
    return float(np.mean([average_precision(m, weights) for m in matches]))


def bootstrap(runs: list[dict[str, list[Matches]]], draws: int, seed: int = 0) -> np.ndarray:
    """[draws, 3] mean AP of ns, learned, matched under resampled seeds and images."""
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(draws):
        chosen = [runs[i] for i in random.integers(len(runs), size=len(runs))]
        each = []
        for run in chosen:
            count = len(run["ns"][0].boxes_per_image)
            weights = np.bincount(random.integers(count, size=count), minlength=count).astype(float)
            each.append([mean_ap(run[w], weights) for w in WHICH])
        rows.append(np.mean(each, 0))
    return np.asarray(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    held = [read(folder) for folder in arguments.runs]
    table = np.asarray([[mean_ap(matches[w]) for w in WHICH] for _, matches in held])
    print(
        f"{'seed':>6}"
        + "".join(f"{w:>10}" for w in WHICH)
        + f"{'fall':>8}{'won back':>10}   biased bin, learned: target"
    )
    for (results, _), row in zip(held, table, strict=True):
        fall, bins = row[2] - row[0], []
        for name in results["biased"]:
            psi = results["psi"][name]
            best, wanted = int(np.argmax(psi["learned"])), int(np.argmax(psi["target"]))
            bins.append(f"{name} {best + 1}: {wanted + 1}")
        line = "".join(f"{100 * value:>10.1f}" for value in row)
        print(
            f"{results['seed']:>6}{line}{100 * fall:>8.1f}{(row[1] - row[0]) / fall:>10.0%}   {', '.join(bins)}"
        )
    mean, spread = table.mean(0), bootstrap([matches for _, matches in held], arguments.draws)
    won = (mean[1] - mean[0]) / (mean[2] - mean[0])
    interval = np.quantile((spread[:, 1] - spread[:, 0]) / (spread[:, 2] - spread[:, 0]), [0.025, 0.975])
    print(
        f"{'mean':>6}"
        + "".join(f"{100 * value:>10.1f}" for value in mean)
        + f"{100 * (mean[2] - mean[0]):>8.1f}{won:>10.0%}"
    )
    print(
        f"won back {won:.0%}, 95 % interval {interval[0]:.0%} to {interval[1]:.0%} ({arguments.draws} draws)"
    )
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        held_json = {
            "ap": dict(zip(WHICH, mean.tolist(), strict=True)),
            "won_back": won,
            "interval": interval.tolist(),
        }
        arguments.json.write_text(json.dumps(held_json, indent=1))


if __name__ == "__main__":
    main()
