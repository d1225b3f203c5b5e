"""AP of several sources: means, paired intervals, the table and what is written."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from mlflow import MlflowClient

from neural_sim.report.score_table import ScoreTable, match
from neural_sim.studies.sources import SideBySide, publish, table
from neural_sim.types import LabelledImages

BOX = torch.tensor([[10.0, 10.0, 30.0, 30.0]])


def truth(count):
    """One box of class 0 in even images, of class 1 in odd ones."""
    labels = (torch.arange(count) % 2)[:, None]
    return LabelledImages(
        torch.rand(count, 3, 40, 40), BOX.expand(count, 1, 4), labels, torch.zeros(count).long()
    )


def detections(images, right):
    """The true box where ``right`` says so, else a box far from it."""
    return [
        {"boxes": BOX if hit else BOX - 10.0, "labels": label, "scores": torch.tensor([0.9])}
        for hit, label in zip(right, images.labels, strict=True)
    ]


def found(draws=200):
    """Three sources, of which the first finds all, the second as well, the third the boxes of class 0 alone."""
    images = truth(24)
    hits = ([True] * 24, [True] * 24, [i % 2 == 0 for i in range(24)])
    rows = [[match(detections(images, hit), images, label) for label in (0, 1)] for hit in hits]
    outcomes = {source: [row, row] for source, row in zip(("nerf", "mesh", "other"), rows, strict=True)}
    return SideBySide.of({"single": ScoreTable.of(outcomes, ["can", "mug"], draws)}, [0, 1], {"single": 48})


def test_ap_and_paired_differences():
    result = found()
    ap = {source: estimate.value for source, estimate in result.ap["single"].items()}
    assert ap == pytest.approx({"nerf": 1.0, "mesh": 1.0, "other": 0.5})
    same, behind = result.ahead["single"]["mesh"], result.ahead["single"]["other"]
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0) and not same.certain
    assert behind.value == pytest.approx(0.5) and behind.certain
    assert result.per_class["single"]["other"] == pytest.approx({"can": 1.0, "mug": 0.0})


def test_the_interval_covers_the_spread_over_images():
    """A source that finds each box with probability 1/2: precision 1 at the recalls that it reaches, so that AP is the
    fraction found; its standard deviation over 400 images is 0.025."""
    images = truth(400)
    hit = np.random.default_rng(0).random(400) < 0.5
    kept = [
        d if h else {k: v[:0] for k, v in d.items()}
        for d, h in zip(detections(images, hit), hit, strict=True)
    ]
    row = [match(kept, images, label) for label in (0, 1)]
    table_of_one = ScoreTable.of({"nerf": [row], "mesh": [row]}, ["can", "mug"], 300)
    estimate = SideBySide.of({"single": table_of_one}, [0], {"single": 400}).ap["single"]["nerf"]
    # 101 recalls: AP is the fraction to within 1/101.
    assert estimate.value == pytest.approx(hit.mean(), abs=0.011)
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * 0.025, rel=0.25)


def test_the_table_and_the_files_have_every_source(context):
    result, shown = found(20), LabelledImages.concatenate([truth(4)] * 3)
    text = table(result, "A heading.")
    assert "| single | 48 | 100.0 (100.0 to 100.0) |" in text and "nerf ahead of other by" in text
    assert "| single, mug | 100.0 | 100.0 | 0.0 |" in text
    assert "| **50.0** (" in text and "Differences in bold exceed the spread." in text
    one = table(replace(result, seeds=(0,)), "A heading.")
    assert "**" not in one and "bold" not in one and "intervals over test images; seed 0." in one
    run = publish(context, result, shown, ["can", "mug"], "A heading.")
    document = json.loads((context.folder / "study.json").read_text())
    assert document["ap"]["single"]["other"]["value"] == pytest.approx(0.5)
    assert {path.name for path in (context.folder / "figures").iterdir()} == {
        "ap.png",
        "training_images.png",
    }
    assert MlflowClient(context.uri).get_run(run.run_id).data.metrics["single/mesh/ap"] == pytest.approx(1.0)
